"""Training a detector on the segmentation of demonstrations."""

from pathlib import Path

from openvima.multiprocess import Report
from openvima.training.detector.config import DetectorTrainingConfig


def train_detector(config: DetectorTrainingConfig, report: Report | None = None) -> Path:
    """Train a detector, or resume a run; see `openvima.training.detector.stage.train_detector`.

    Raises:
        MissingExtraError: torch is not installed.
    """
    from openvima.policies.base import require_torch

    require_torch("training a detector")
    from openvima.training.detector import stage

    return stage.train_detector(config, report)


__all__ = ["DetectorTrainingConfig", "train_detector"]
