"""Behaviour cloning: data to tensors, the loop, run folders."""

from collections.abc import Callable
from pathlib import Path

from openvima.training.config import TrainingConfig


def train(
    config: TrainingConfig,
    report: Callable[[int, int, str], None] | None = None,
    rollout: Callable[[Path], dict[str, float]] | None = None,
) -> Path:
    """Train a policy on demonstrations, or go on with a run; see `openvima.training.loop.train`.

    Raises:
        MissingExtraError: torch is not installed.
    """
    from openvima.policies.base import require_torch

    require_torch("training")
    from openvima.training import loop

    return loop.train(config, report, rollout)


__all__ = ["TrainingConfig", "train"]
