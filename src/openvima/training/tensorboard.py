"""TensorBoard events, in addition to `metrics.jsonl`."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

BOARD_FOLDER = "tensorboard_log"  # events hold times, so they differ between machines


class Board:
    """Writes events if `tensorboard` is installed.

    Args:
        run: The run folder.
        first: First step of this session, counted through all stages; later events are purged.
        wanted: False writes nothing.
    """

    def __init__(self, run: Path, first: int, *, wanted: bool) -> None:
        self._run, self._first = run, first
        self._wanted = wanted and find_spec("tensorboard") is not None
        self._writer: Any = None  # Any: an optional package

    def add(self, prefix: str, values: Mapping[str, Any], step: int) -> None:
        """Write named numbers at a step, counted through all stages."""
        if not self._wanted:
            return
        if self._writer is None:  # restarting a finished run writes no empty file
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(self._run / BOARD_FOLDER), purge_step=self._first)
        for name, value in values.items():
            if isinstance(value, int | float):
                self._writer.add_scalar(f"{prefix}/{name}", value, step)

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            self._writer.close()
