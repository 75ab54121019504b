"""Experiment trackers, in addition to `metrics.jsonl`: TensorBoard, and Weights & Biases."""

import io
import secrets
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias

from openvima.atomic_io import atomic_write_file
from openvima.imports import import_extra
from openvima.input_files import read_text
from openvima.training.config import RunConfig
from openvima.video.encoder import Animation

BOARD_FOLDER = "tensorboard_log"  # events hold times, so they differ between machines
WANDB_FOLDER = "wandb_log"
_ID_FILE = "id.txt"


class TensorBoardTracker:
    """Writes TensorBoard events to `RUN/tensorboard_log`.

    Args:
        run: The run folder.
        first: First step of this session.
    """

    def __init__(self, run: Path, first: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(run / BOARD_FOLDER), purge_step=first)

    def add(self, prefix: str, values: Mapping[str, float], step: int) -> None:
        """Log named numbers."""
        for name, value in values.items():
            self._writer.add_scalar(f"{prefix}/{name}", value, step)

    def add_animations(self, prefix: str, animations: Sequence[Animation], step: int) -> None:
        """Log rollouts as animated images."""
        from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore  # generated at run time

        for animation in animations:
            tag = f"{prefix}/{animation.name}"
            self._writer.add_image(f"{tag}/prompt", animation.prompt, step, dataformats="HWC")
            _, height, width, _ = animation.frames.shape
            image = Summary.Image(
                height=height, width=width, colorspace=3, encoded_image_string=animation.gif()
            )
            summary = Summary(value=[Summary.Value(tag=f"{tag}/rollout", image=image)])
            self._writer.file_writer.add_summary(summary, step)

    def close(self) -> None:
        """Write what is left."""
        self._writer.close()


class WandbTracker:
    """Logs to a project of Weights & Biases, whose variables, such as WANDB_MODE=offline, apply.

    A resumed run continues the same run there.

    Args:
        run: The run folder; wandb's files are in `RUN/wandb_log`.
        project: The project.
        settings: Settings of the run, for comparing runs.

    Raises:
        MissingExtraError: `wandb` is not installed.
    """

    def __init__(self, run: Path, project: str, settings: Mapping[str, Any]) -> None:
        needs = f"runtime.wandb is {project!r}; install wandb: pip install 'openvima[wandb]'"
        self._wandb: Any = import_extra("wandb", needs)
        folder = run / WANDB_FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / _ID_FILE
        if not file.exists():
            atomic_write_file(file, secrets.token_hex(8))
        self._session = self._wandb.init(
            project=project,
            name=run.name,
            id=read_text(file),
            resume="allow",
            dir=str(folder),
            config=dict(settings),
        )

    def add(self, prefix: str, values: Mapping[str, float], step: int) -> None:
        """Log named numbers."""
        self._session.log({f"{prefix}/{name}": value for name, value in values.items()}, step=step)

    def add_animations(self, prefix: str, animations: Sequence[Animation], step: int) -> None:
        """Log rollouts as videos, with what became of them as captions."""
        media = {}
        for animation in animations:
            gif = io.BytesIO(animation.gif())
            tag = f"{prefix}/{animation.name}"
            media[f"{tag}/prompt"] = self._wandb.Image(animation.prompt)
            media[f"{tag}/rollout"] = self._wandb.Video(gif, format="gif", caption=animation.caption)
        self._session.log(media, step=step)

    def close(self) -> None:
        """Upload or write what is left."""
        self._session.finish()


Tracker: TypeAlias = TensorBoardTracker | WandbTracker
"""Where metrics and animations of a run are logged; steps are counted through all stages."""


def open_trackers(config: RunConfig, run: Path, first: int) -> list[Tracker]:
    """Open the trackers that the settings ask for.

    Args:
        config: Settings of the run.
        run: The run folder.
        first: First step of this session; TensorBoard's later events are purged.

    Raises:
        MissingExtraError: `wandb` is asked for and not installed. TensorBoard is then left out.
    """
    trackers: list[Tracker] = []
    if config.runtime.wandb:
        trackers.append(WandbTracker(run, config.runtime.wandb, config.identity()))
    if config.runtime.tensorboard and find_spec("tensorboard") is not None:
        trackers.append(TensorBoardTracker(run, first))
    return trackers
