"""Everything that decides a training run, as a frozen record that checks itself."""

from dataclasses import dataclass
from pathlib import Path

from openvima.errors import ConfigError, unknown_name
from openvima.policies.presets import PRESETS

MATCHING_STEPS = 400  # of presets with an appearance embedding

# Smallest and largest allowed value of each number; None means no bound on that side.
_BOUNDS: dict[str, tuple[float, float | None]] = {
    "steps": (1, None),
    "batch": (1, None),
    "learning_rate": (0, 1),
    "warmup_steps": (0, None),
    "weight_decay": (0, None),
    "clip_norm": (0, None),
    "spurious_probability": (0, 1),
    "pretraining_steps": (0, None),
    "pretraining_scenes": (1, None),
    "pretraining_batch": (2, None),
    "pretraining_learning_rate": (0, 1),
    "temperature": (1e-3, None),
    "seed": (0, 2**63 - 1),
    "validation_share": (0, 0.9),
    "checkpoint_every": (1, None),
    "threads": (1, 1024),
}


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """One training run: first the crop encoder on rendered pairs, if the preset matches looks; then cloning.

    Args:
        data: Folder of demonstrations, as `openvima generate` writes it.
        out: Run folder: checkpoints, settings, metrics.
        tokens: Folder of the token cache; None keeps it beside the demonstrations.
        preset: Network and sizes, such as "nano" or "gato-nano"; `openvima policies` lists them.
        steps: Steps of behaviour cloning.
        batch: Demonstrations a step.
        learning_rate: Highest learning rate of cloning.
        warmup_steps: Steps over which the learning rate rises from 0; afterwards it falls along a cosine.
        weight_decay: Decay of weight matrices, as in AdamW.
        clip_norm: Largest norm of the gradient.
        spurious_probability: How often each view of each step shows an object that is none.
        pretraining_steps: Steps in which the crop encoder learns to match prompt and scene; 0 leaves it out,
            and the image encoder then learns while cloning. None is as the preset wants: 400 with an
            appearance embedding (nano, nano-bins), 0 without one.
        pretraining_scenes: Scenes drawn for that.
        pretraining_batch: Pairs of one object a step.
        pretraining_learning_rate: Highest learning rate of that.
        temperature: Divisor of similarities in the matching loss.
        tune_crops: Go on training the crop encoder while cloning. Slower: each step encodes its crops anew.
        t5: Where presets that read prompts with T5 take its weights and tokenizer from: a folder, or an id on
            the Hugging Face Hub such as "t5-base".
        assets: Asset pack to draw the pairs with: "procedural", or the folder of the original one.
        seed: Decides weights, order and augmentation.
        validation_share: Share of the demonstrations that only serve to choose the best checkpoint.
        checkpoint_every: Steps between checkpoints.
        threads: Threads to compute with; equal numbers give equal weights. The nano network gains a fifth
            from a second one, and loses much when other programs need that core.
        force: Throw away what is in the run folder if it belongs to other settings.
    """

    data: Path
    out: Path
    preset: str = "nano"
    steps: int = 400
    batch: int = 64
    learning_rate: float = 1e-3
    warmup_steps: int = 50
    weight_decay: float = 0.01
    clip_norm: float = 1.0
    spurious_probability: float = 0.05
    pretraining_steps: int | None = None
    pretraining_scenes: int = 2500
    pretraining_batch: int = 128
    pretraining_learning_rate: float = 1e-3
    temperature: float = 0.07
    tune_crops: bool = False
    t5: str | None = None
    assets: str = "procedural"
    seed: int = 0
    validation_share: float = 0.05
    checkpoint_every: int = 100
    threads: int = 1
    tokens: Path | None = None
    force: bool = False

    def __post_init__(self) -> None:
        problems = []
        if self.preset not in PRESETS:
            hint = "`openvima policies` lists all."
            problems.append(unknown_name("preset", self.preset, PRESETS, hint))
        for name, (low, high) in _BOUNDS.items():
            if name == "pretraining_steps" and self.pretraining_steps is None:
                continue
            value = getattr(self, name)
            if not (low <= value and (high is None or value <= high)):
                allowed = f"at least {low:g}" if high is None else f"between {low:g} and {high:g}"
                problems.append(f"{name} is {value:g}; it must be {allowed}.")
        if problems:
            raise ConfigError(" ".join(problems))
