"""Object detection in pixels: a Mask R-CNN in plain torch, its training data and its evaluation.

The network is own code because torchvision, which has one, cannot be installed everywhere beside torch: its
wheels do not load with torch's CPU build.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from openvima.detector.config import DETECTORS, BackboneConfig, DetectorConfig, detector_config
from openvima.errors import InputFileError
from openvima.input_files import as_path

if TYPE_CHECKING:
    from openvima.detector.detection import DetectedObjects
    from openvima.detector.network import FrameDetector

BUNDLED = Path(__file__).parent / "trained"  # the small detector for the default assets
CACHE_SIZE = 1024  # of extractors, in pairs of images; 30 MB, and a larger one is hardly hit more often


def detector_folder(folder: str | Path | None = None) -> Path:
    """Return the folder of a trained detector; None is the bundled one.

    Raises:
        InputFileError: There is no such folder.
    """
    path = BUNDLED if folder is None else as_path(folder)
    if path.is_dir():
        return path
    raise InputFileError(
        f"there is no folder {path}; `openvima detector train --data DIR --out RUN` makes one."
    )


def load_detector(folder: str | Path | None = None, **options: Any) -> "FrameDetector":
    """Load a trained detector.

    Args:
        folder: A run folder of `openvima detector train`, whose best checkpoint is loaded, or a checkpoint
            folder; None is the bundled detector.
        **options: Of `FrameDetector`, such as `device`.

    Raises:
        InputFileError: There is no checkpoint, or it is damaged.
        MissingExtraError: torch is not installed.
    """
    from openvima.policies.base import require_torch

    require_torch("a detector")
    from openvima.detector.checkpoint import load_network
    from openvima.detector.network import FrameDetector

    return FrameDetector(load_network(detector_folder(folder)), **options)


def load_extractor(folder: str | Path | None = None, **options: Any) -> "DetectedObjects":
    """Load a trained detector as an object extractor for policies; see `load_detector`.

    Example:
        >>> load_policy("run", extractor=load_extractor())
    """
    from openvima.detector.detection import DetectedObjects

    return DetectedObjects(load_detector(folder, **options), cache_size=CACHE_SIZE)


__all__ = [
    "BUNDLED",
    "DETECTORS",
    "BackboneConfig",
    "DetectorConfig",
    "detector_config",
    "detector_folder",
    "load_detector",
    "load_extractor",
]
