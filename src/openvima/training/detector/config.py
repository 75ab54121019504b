"""Settings of a detector's training, as nested frozen dataclasses."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from openvima.detector.config import DETECTORS
from openvima.errors import unknown_name
from openvima.policies.config_fields import Range
from openvima.training.config import Count, OptimizerConfig, Probability, RunConfig, ScheduleConfig

_OPTIMIZER = OptimizerConfig(max_grad_norm=5.0)
_SCHEDULE = ScheduleConfig(steps=4200, warmup_steps=100, checkpoint_every=200)


@dataclass(frozen=True, slots=True)
class FrameLoaderConfig:
    """Batches and held-out frames.

    Args:
        batch_size: Frames a step, two views of each moment.
        prompt_prob: Probability of drawing a prompt image instead of an observation.
        rerendered_prob: Probability of rendering a frame's demonstration with random shapes and textures;
            gratings and containers with ears are among them.
        paste_prob: Probability of pasting a copy of an object onto an object, as in stacks and containers.
        augment: Random colours and horizontal flips.
        validation_fraction: Fraction of the demonstrations held out to choose the best checkpoint.
        validation_frames: Frames drawn from them.
    """

    batch_size: Annotated[int, Range(2)] = 16
    prompt_prob: Probability = 0.25
    rerendered_prob: Probability = 0.0
    paste_prob: Probability = 0.0
    augment: bool = True
    validation_fraction: Annotated[float, Range(0, 0.9)] = 0.02
    validation_frames: Annotated[int, Range(2)] = 200


@dataclass(frozen=True, slots=True)
class DetectorTrainingConfig(RunConfig):
    """One training run of a detector.

    Args:
        preset: Sizes: "small", or "resnet50" for the published architecture.
        init_from: Initial weights: a run folder, a checkpoint folder, or a file of Detectron2. They decide
            the sizes, whatever the preset.
        proposals_per_frame: Proposals of a frame that the heads are trained on.
        loader: Batches and held-out frames.
        schedule: Length, learning rate, checkpoints. 1,400 steps of 16 frames are the 22,400 frames of the
            published fine-tuning.
    """

    preset: str = "small"
    init_from: Path | None = None
    proposals_per_frame: Count = 64
    loader: FrameLoaderConfig = FrameLoaderConfig()
    optimizer: OptimizerConfig = _OPTIMIZER
    schedule: ScheduleConfig = _SCHEDULE

    def _unknown(self) -> Iterator[str]:
        if isinstance(self.preset, str) and self.preset not in DETECTORS:
            yield unknown_name("detector", self.preset, DETECTORS)
        batch = self.loader.batch_size
        if isinstance(batch, int) and batch % 2:
            yield f"loader.batch_size is {batch}; it must be even, as frames come in pairs of views."
