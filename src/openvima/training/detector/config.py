"""Everything that decides the training of a detector, as a frozen record that checks itself."""

from dataclasses import dataclass
from pathlib import Path

from openvima.detector.config import DETECTORS
from openvima.errors import ConfigError, unknown_name
from openvima.training.validation import problems_of

# Smallest and largest allowed value of each number; None means no bound on that side.
_BOUNDS: dict[str, tuple[float, float | None]] = {
    "steps": (1, None),
    "batch": (2, None),
    "learning_rate": (0, 1),
    "warmup_steps": (0, None),
    "weight_decay": (0, None),
    "clip_norm": (1e-6, None),
    "sampled": (1, None),
    "prompt_share": (0, 1),
    "seed": (0, 2**63 - 1),
    "validation_share": (0, 0.9),
    "validation_frames": (2, None),
    "checkpoint_every": (1, None),
    "threads": (1, 1024),
}


@dataclass(frozen=True, slots=True)
class DetectorTrainingConfig:
    """One training run of a detector.

    Args:
        data: Folder of demonstrations with images, as `openvima generate` writes it.
        out: Run folder: checkpoints, settings, metrics.
        preset: Sizes: "small", or "resnet50" for the published architecture.
        init: Detector whose weights to begin with: a run folder, a checkpoint folder, or a file of
            Detectron2. It decides the sizes, whatever the preset.
        steps: Steps of a batch each; 1,400 of 16 frames are the 22,400 frames of the published fine-tuning.
        batch: Frames a step, two of each moment.
        learning_rate: Highest learning rate, of AdamW; it rises over the warm-up and falls along a cosine.
        warmup_steps: Steps of the rise, at most a third of the run.
        weight_decay: Decay of weight matrices.
        clip_norm: Largest norm of the gradient.
        sampled: Proposals of a frame that the heads learn from.
        prompt_share: Share of the moments that show an image of a prompt.
        augment: Give objects other colours and exchange left and right, at random.
        seed: Decides weights, order, and all that is drawn.
        validation_share: Share of the demonstrations that only serve to choose the best checkpoint.
        validation_frames: Frames drawn from them.
        checkpoint_every: Steps between checkpoints, each with a validation.
        device: "auto" takes a GPU where there is one; or "cpu", "cuda".
        threads: Threads to compute with; equal numbers give equal weights.
        force: Throw away what is in the run folder if it belongs to other settings.
    """

    data: Path
    out: Path
    preset: str = "small"
    init: Path | None = None
    steps: int = 4200
    batch: int = 16
    learning_rate: float = 1e-3
    warmup_steps: int = 100
    weight_decay: float = 0.01
    clip_norm: float = 5.0
    sampled: int = 64
    prompt_share: float = 0.25
    augment: bool = True
    seed: int = 0
    validation_share: float = 0.02
    validation_frames: int = 200
    checkpoint_every: int = 200
    device: str = "auto"
    threads: int = 1
    force: bool = False

    def __post_init__(self) -> None:
        problems = list(problems_of(self, _BOUNDS))
        if isinstance(self.preset, str) and self.preset not in DETECTORS:
            problems.append(unknown_name("detector", self.preset, DETECTORS))
        if isinstance(self.batch, int) and self.batch % 2:
            problems.append(f"batch is {self.batch}; it must be even, as frames come in pairs of views.")
        if problems:
            raise ConfigError(" ".join(problems))
