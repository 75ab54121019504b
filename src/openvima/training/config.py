"""Everything that decides a training run, as a frozen record that checks itself."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from openvima.errors import ConfigError, unknown_name
from openvima.policies.presets import PRESETS
from openvima.training.validation import problems_of

MATCHING_STEPS = 400  # of presets with an appearance embedding
DETECTED_SHARE = 0.5  # where there are boxes of a detector

# Smallest and largest allowed value of each number; None means no bound on that side.
_BOUNDS: dict[str, tuple[float, float | None]] = {
    "steps": (1, None),
    "epochs": (0.001, None),
    "batch": (1, None),
    "accumulate": (1, None),
    "learning_rate": (0, 1),
    "final_learning_rate": (0, 1),
    "warmup_steps": (0, None),
    "decay_steps": (1, None),
    "weight_decay": (0, None),
    "clip_norm": (1e-6, None),
    "spurious_probability": (0, 1),
    "motion_share": (0, 1),
    "bystander_share": (0, 1),
    "naming_share": (0, 1),
    "reordering_share": (0, 1),
    "stranger_share": (0, 1),
    "detected_share": (0, 1),
    "pretraining_steps": (0, None),
    "pretraining_scenes": (1, None),
    "pretraining_batch": (2, None),
    "pretraining_learning_rate": (0, 1),
    "pretraining_random_looks": (0, 1),
    "pretraining_twins": (0, 1),
    "pretraining_box_shift": (0, 8),
    "pretraining_grays": (0, 1),
    "pretraining_gaps": (0, 1),
    "temperature": (1e-3, None),
    "bucket": (0, None),
    "seed": (0, 2**63 - 1),
    "validation_share": (0, 0.9),
    "validation_episodes": (1, None),
    "checkpoint_every": (1, None),
    "keep_every": (1, None),
    "rollout_every": (1, None),
    "rollout_episodes": (1, None),
    "loader_workers": (0, 1024),
    "threads": (1, 1024),
}


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """One training run: first the crop encoder on rendered pairs, if the preset matches looks; then cloning.

    Args:
        data: Folder of demonstrations, as `openvima generate` writes it.
        out: Run folder: checkpoints, settings, metrics.
        preset: Network and sizes, such as "nano" or "gato-nano" (`openvima policies` lists them); or
            "module:function" for a `Learner` of your own.
        autoregressive: Whether each component of an action is a token of its own; None is as the preset has
            it.
        visual_residual: Whether object tokens are added to the encoded prompt; None is as the preset has it.
        init: Weights to begin with: those of another run, or whatever else `load_policy` takes; None begins
            anew.
        steps: Steps of behaviour cloning.
        epochs: Passes over the demonstrations, instead of `steps`; None takes those.
        batch: Demonstrations a step, of all processes together; at most as many as there are.
        accumulate: Parts in which each process takes its share of a batch, one after the other, to save
            memory.
        learning_rate: Highest learning rate of cloning.
        final_learning_rate: Where the learning rate ends.
        warmup_steps: Steps over which the learning rate rises from 0, at most a third of the run.
        decay_steps: Steps over which it then falls along a cosine; None is to the end of the run.
        weight_decay: Decay of weight matrices, as in AdamW.
        clip_norm: Largest norm of the gradient.
        spurious_probability: How often each view of each step shows an object that is none.
        motion_share: Share of demonstrations that are read as "Follow this motion: frame … frame" instead of
            with the prompt of their task: 1 for inverse dynamics pretraining, part of them for use in
            context. The checkpoint is chosen by tasks, unless it is 1.
        bystander_share: How probable it is for each object that nothing is done with in a motion that it is
            out of view, and how probable that pictures of the motion leave it out. Needs true boxes.
        naming_share: Share of demonstrations whose prompts get invented nouns for objects: "This is a wug
            {image}." Those that have invented words of their own stay as they are.
        reordering_share: Share of demonstrations in whose prompts sentences that explain invented words come
            in any order, and of several comparisons perhaps only some.
        stranger_share: Share of the demonstrations of five tasks, whose prompts show whatever matters, into
            whose view up to three objects of another demonstration come.
        boxes: Detector whose boxes part of the demonstrations are shown with, images of prompts included:
            "detector" for the one that comes with the package, "detector=folder" for another trained one, or
            "module:function" or "file.py:function", which makes an `ObjectExtractor`.
        detected_share: Share of demonstrations that are shown with these boxes instead of the true ones,
            drawn anew in each batch; None is half of them where `boxes` are given. The checkpoint is chosen
            by true boxes, unless it is 1.
        pretraining_steps: Steps in which the crop encoder learns to match prompt and scene; 0 leaves it out,
            and the image encoder then learns while cloning. None is as the preset wants: 400 with an
            appearance embedding (nano, nano-bins), 0 without one or with `init`; from there such an encoder
            is taken over, and stays as it is unless `tune_crops` is set.
        pretraining_scenes: Scenes drawn for that.
        pretraining_batch: Pairs of one object a step.
        pretraining_learning_rate: Highest learning rate of that.
        pretraining_random_looks: How probable it is for each object of these scenes that a random texture
            replaces that of the training partition, and how probable a random shape.
        pretraining_twins: How probable it is for each object that can be moved that a twin lies beside it
            which differs in height, shade, texture or shape alone. Above 0 batches are of whole scenes, and
            each scene is laid a second time with everything turned.
        pretraining_grays: How probable it is for each object that its prompt image is gray, so that its shape
            alone tells it.
        pretraining_gaps: How probable it is for each object that gaps are painted over it, through which the
            ground shows: white in prompt images, the table in scenes.
        pretraining_box_shift: Largest random shift of a crop's borders, in pixels of its 32, as with the
            boxes of a detector.
        temperature: Divisor of similarities in the matching loss.
        tune_crops: Go on training the crop encoder while cloning. Slower: each step encodes its crops anew.
        bucket: Batches among which demonstrations are sorted by length, to pad less; 0 draws each batch
            from all.
        t5: Where presets that read prompts with T5 take its weights and tokenizer from: a folder, or an id on
            the Hugging Face Hub such as "t5-base".
        assets: Asset pack to draw the pairs with: "procedural", or the folder of the original one.
        seed: Decides weights, order and augmentation.
        validation_share: Share of the demonstrations that only serve to choose the best checkpoint.
        validation_episodes: At most so many of them.
        checkpoint_every: Steps between checkpoints, each with a validation; those to be kept or played come
            on top.
        keep_every: Steps between checkpoints that are kept; None keeps the latest and the best only.
        rollout_every: Steps between trials in the simulator; None leaves them out.
        rollout_episodes: Episodes of each task of a trial.
        device: "auto" takes a GPU where there is one; or "cpu", "cuda".
        precision: "float32", or "bfloat16" for products of matrices, with weights in float32.
        compile: Compile the layers of the network with torch.compile: slow to start, then faster on a GPU.
        sharding: With several processes "ddp" keeps the network whole in each, "fsdp" divides it.
        loader_workers: Processes that read batches ahead.
        threads: Threads to compute with; equal numbers give equal weights. The nano network gains a fifth
            from a second one, and loses much when other programs need that core.
        tensorboard: Write events for TensorBoard too, if it is installed.
        tokens: Folder of the token cache; None keeps it beside the demonstrations.
        force: Throw away what is in the run folder if it belongs to other settings.
    """

    data: Path
    out: Path
    preset: str = "nano"
    autoregressive: bool | None = None
    visual_residual: bool | None = None
    init: str | None = None
    steps: int = 400
    epochs: float | None = None
    batch: int = 64
    accumulate: int = 1
    learning_rate: float = 1e-3
    final_learning_rate: float = 0.0
    warmup_steps: int = 50
    decay_steps: int | None = None
    weight_decay: float = 0.01
    clip_norm: float = 1.0
    spurious_probability: float = 0.05
    motion_share: float = 0.0
    bystander_share: float = 0.0
    naming_share: float = 0.0
    reordering_share: float = 0.0
    stranger_share: float = 0.0
    boxes: str | None = None
    detected_share: float | None = None
    pretraining_steps: int | None = None
    pretraining_scenes: int = 2500
    pretraining_batch: int = 128
    pretraining_learning_rate: float = 1e-3
    pretraining_random_looks: float = 0.0
    pretraining_twins: float = 0.0
    pretraining_box_shift: float = 0.0
    pretraining_grays: float = 0.0
    pretraining_gaps: float = 0.0
    temperature: float = 0.07
    tune_crops: bool = False
    bucket: int = 0
    t5: str | None = None
    assets: str = "procedural"
    seed: int = 0
    validation_share: float = 0.05
    validation_episodes: int = 4096
    checkpoint_every: int = 100
    keep_every: int | None = None
    rollout_every: int | None = None
    rollout_episodes: int = 10
    device: str = "auto"
    precision: Literal["float32", "bfloat16"] = "float32"
    compile: bool = False
    sharding: Literal["ddp", "fsdp"] = "ddp"
    loader_workers: int = 0
    threads: int = 1
    tensorboard: bool = True
    tokens: Path | None = None
    force: bool = False

    def __post_init__(self) -> None:
        problems = []
        if isinstance(self.preset, str) and self.preset not in PRESETS and ":" not in self.preset:
            hint = "`openvima policies` lists all."
            problems.append(unknown_name("preset", self.preset, PRESETS, hint))
        problems += problems_of(self, _BOUNDS)
        if problems:
            raise ConfigError(" ".join(problems))
