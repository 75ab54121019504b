"""Metrics for TensorBoard, beside the lines of `metrics.jsonl`, which are always written."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

BOARD_FOLDER = "tensorboard_log"  # events hold times, so they differ between machines


class Board:
    """Writes events where `tensorboard` is installed, and else nothing.

    Args:
        run: The run folder.
        wanted: False writes nothing either.
    """

    def __init__(self, run: Path, *, wanted: bool) -> None:
        self._writer: Any = None  # Any: an optional package
        if wanted and find_spec("tensorboard") is not None:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(run / BOARD_FOLDER))

    def add(self, prefix: str, values: Mapping[str, Any], step: int) -> None:
        """Write named numbers at a step, counted through all stages."""
        if self._writer is None:
            return
        for name, value in values.items():
            if isinstance(value, int | float):
                self._writer.add_scalar(f"{prefix}/{name}", value, step)

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            self._writer.close()
