"""Training of policies and detectors: nested settings, one loop with stages, run folders."""

from collections.abc import Callable
from pathlib import Path

from openvima.multiprocess import Report
from openvima.training.config import TrainingConfig
from openvima.video.encoder import Animation


def train(
    config: TrainingConfig,
    report: Report | None = None,
    rollout: Callable[[Path], dict[str, float]] | None = None,
    animate: Callable[[Path], list[Animation]] | None = None,
) -> Path:
    """Train a policy on demonstrations, or resume a run; see `openvima.training.policy.train`.

    Raises:
        MissingExtraError: torch is not installed.
    """
    from openvima.policies.base import require_torch

    require_torch("training")
    from openvima.training import policy

    return policy.train(config, report, rollout, animate)


__all__ = ["TrainingConfig", "train"]
