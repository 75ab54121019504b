"""Objects from pixels: a Mask R-CNN in plain torch, and what it is trained on and scored with."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from openvima.detector.config import DETECTORS, BackboneConfig, DetectorConfig, detector_config
from openvima.errors import CheckpointError

if TYPE_CHECKING:
    from openvima.detector.detector import FrameDetector
    from openvima.policies.detection import DetectedObjects

PACKAGED = Path(__file__).parent / "trained"  # the small detector for the default assets


def detector_folder(folder: str | Path | None = None) -> Path:
    """Return where a trained detector lies, if there is one; `load_detector` takes the same.

    Raises:
        CheckpointError: There is none.
    """
    path = PACKAGED if folder is None else Path(folder)
    if path.is_dir():
        return path
    raise CheckpointError(
        f"there is no folder {path}; `openvima detector train --data DIR --out RUN` makes one. Give its "
        "folder."
    )


def load_detector(
    folder: str | Path | None = None, **options: Any
) -> "FrameDetector":  # Any: of several kinds
    """Load a trained detector.

    Args:
        folder: A run folder that `openvima detector train` wrote, of which the best checkpoint is taken, or a
            checkpoint folder; None takes the small detector that comes with the package.
        **options: Of `FrameDetector`, such as `device`.

    Raises:
        CheckpointError: There is no checkpoint, or it is damaged.
        MissingExtraError: torch is not installed.
    """
    from openvima.policies.base import require_torch

    require_torch("a detector")
    from openvima.detector.checkpoint import load_network
    from openvima.detector.detector import FrameDetector

    return FrameDetector(load_network(detector_folder(folder)), **options)


def load_extractor(folder: str | Path | None = None, **options: Any) -> "DetectedObjects":  # Any: as above
    """Load a trained detector as what policies take for an extractor; see `load_detector`.

    Example:
        >>> load_policy("run", extractor=load_extractor())
    """
    from openvima.policies.detection import DetectedObjects

    return DetectedObjects(load_detector(folder, **options))


__all__ = [
    "DETECTORS",
    "PACKAGED",
    "BackboneConfig",
    "DetectorConfig",
    "detector_config",
    "detector_folder",
    "load_detector",
    "load_extractor",
]
