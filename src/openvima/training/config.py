"""Settings of a training run, as nested frozen dataclasses that are validated together."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_type_hints

from openvima.errors import ConfigError, echo, unknown_name
from openvima.input_files import settle
from openvima.policies.config_fields import Range, options_of, problems_of
from openvima.policies.naming import BUNDLED
from openvima.policies.presets import PRESETS, own_policies

Count = Annotated[int, Range(1)]
Steps = Annotated[int, Range(0)]
Probability = Annotated[float, Range(0, 1)]

PRETRAINING_STEPS = 400  # of presets with an appearance embedding
DETECTED_PROB = 0.5  # where a detector is named
# Paths and execution do not identify a run.
_NOT_IDENTITY = {
    "": ("data", "out", "force", "object_cache", "t5", "rollout"),
    "loader": ("num_workers",),
    "schedule": ("checkpoint_every", "keep_every"),
    "runtime": ("device", "threads", "workers", "tensorboard", "wandb"),
}


def flatten(values: Any, prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings; names are joined by dots."""
    if not isinstance(values, Mapping):
        return {prefix: values}
    result: dict[str, Any] = {}
    for name, value in values.items():
        result |= flatten(value, f"{prefix}.{name}" if prefix else str(name))
    return result


def setting_types(kind: type, prefix: str = "") -> dict[str, Any]:
    """Return the type of every setting of a dataclass by its dotted name."""
    types: dict[str, Any] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        types |= (
            setting_types(hint, f"{prefix}{name}.")
            if isinstance(hint, type) and is_dataclass(hint)
            else {prefix + name: hint}
        )
    return types


@dataclass(frozen=True, slots=True)
class LoaderConfig:
    """Batches and held-out demonstrations.

    Args:
        batch_size: Demonstrations a step, of all processes together; at most as many as there are.
        num_workers: Processes that read batches ahead.
        bucket_batches: Batches among which demonstrations are sorted by length, to reduce padding; 0 draws
            each batch from all.
        validation_fraction: Fraction of the demonstrations held out to choose the best checkpoint.
        validation_episodes: Maximum number of held-out demonstrations.
        boxes: Detector that replaces the true boxes of some demonstrations: "detector" for the bundled one,
            "detector=folder" for another trained one, or "module:function" or "file.py:function", which
            makes an `ObjectExtractor`.
        detected_prob: Probability of using these boxes, drawn per demonstration and batch; None is 0.5 where
            `boxes` are given. Held-out demonstrations keep true boxes, unless it is 1.
        detected_fraction: Fraction of the demonstrations whose objects are detected at all; the others always
            have true boxes. Detection takes about 0.2 s of CPU time per demonstration.
        rerendered_prob: Probability of using a demonstration rendered again with random shapes and textures,
            drawn per demonstration and batch; together with `detected_prob` at most 1.
        exclude_tasks: Tasks that the run must not see, comma-separated: in no stage, vocabulary or
            validation.
        repeat_tasks: Tasks whose demonstrations an epoch shows several times, such as
            "novel_adj=2,twist=3"; each of the others is shown once.
        first_tasks: Tasks, comma-separated, that the first steps show alone, with their own prompts: what is
            hard to learn among all others stays once it is learned.
        first_steps: Number of these steps.
    """

    batch_size: Count = 64
    num_workers: Annotated[int, Range(0, 1024)] = 0
    bucket_batches: Steps = 0
    validation_fraction: Annotated[float, Range(0, 0.9)] = 0.05
    validation_episodes: Count = 4096
    boxes: str | None = None
    detected_prob: Probability | None = None
    detected_fraction: Probability = 1.0
    rerendered_prob: Probability = 0.0
    exclude_tasks: str = ""
    repeat_tasks: str = ""
    first_tasks: str = ""
    first_steps: Steps = 0

    @property
    def excluded_tasks(self) -> tuple[str, ...]:
        """The excluded tasks, sorted."""
        return _split_names(self.exclude_tasks)

    @property
    def early_tasks(self) -> tuple[str, ...]:
        """The tasks that the first steps show, sorted."""
        return _split_names(self.first_tasks)

    @property
    def repeats(self) -> dict[str, int]:
        """How often an epoch shows the demonstrations of tasks, by name.

        Raises:
            ConfigError: `repeat_tasks` has another form.
        """
        found = {}
        for part in filter(None, self.repeat_tasks.replace(" ", "").split(",")):
            name, _, count = part.partition("=")
            if not (count.isdecimal() and 1 <= int(count) <= 100):
                raise ConfigError(
                    f"loader.repeat_tasks has {echo(repr(part))}; give TASK=COUNT, counts from 1 to 100, "
                    "with commas between them."
                )
            found[name] = int(count)
        return found


def _split_names(names: str) -> tuple[str, ...]:
    return tuple(sorted({name.strip() for name in names.split(",")} - {""}))


@dataclass(frozen=True, slots=True)
class ModelConfig:
    """Parts of the network that differ from the preset; None is as the preset has it.

    Args:
        head: Action head: "bins", independent ones; "autoregressive" bins; "mixture", a mixture density over
            positions and rotation; or "regression". Pointer models (nano, small) have their own.
        visual_residual: Add image tokens to the encoded prompt (MIDAS).
        text_encoder: "small", with its own vocabulary; or "t5-small", "t5-base" or "t5-large", whose files
            `t5` names.
        tuned_layers: Trained layers of the text encoder, the last ones; 0 freezes it.
        image_tokens: Of VIMA and MIDAS: "objects"; four latents of the objects, "object-perceiver"; or whole
            frames as four latents, "image-perceiver", as "patches" or as one "image" token.
        conditioning: The decoder attends to the prompt by "cross-attention"; or the prompt is the "prefix" of
            the history, with twice as many layers of half the size.
        width: Width of the decoder and of image tokens, a multiple of the heads.
        num_layers: Layers of the decoder: pairs of a cross block and a self block, or with a prefix self
            blocks.
        points: Read positions from the objects that the action's output points at, places also from those in
            scenes of the prompt and at the first step; for VIMA and the like with a token for each object.
        attributes: Compare objects by the attributes that a prompt names, such as "the same texture". For the
            preset small; `pretraining.attribute_loss_weight` trains them.
        crop_kernel: Kernel size of the last layer of a convolutional crop encoder (nano, small): 1 takes
            about half of the multiply-adds of 3.
        crop_width: Channels of its first layer, a multiple of 4; the next have 2, 4 and 4 times as many.
    """

    head: Literal["bins", "autoregressive", "mixture", "regression"] | None = None
    visual_residual: bool | None = None
    text_encoder: Literal["small", "t5-small", "t5-base", "t5-large"] | None = None
    tuned_layers: Steps | None = None
    image_tokens: Literal["objects", "object-perceiver", "image-perceiver", "patches", "image"] | None = None
    conditioning: Literal["cross-attention", "prefix"] | None = None
    width: Count | None = None
    num_layers: Count | None = None
    points: bool | None = None
    attributes: bool | None = None
    crop_kernel: Literal[1, 3] | None = None
    crop_width: Count | None = None


@dataclass(frozen=True, slots=True)
class OptimizerConfig:
    """AdamW.

    Args:
        learning_rate: Peak learning rate.
        weight_decay: Decay of weight matrices.
        max_grad_norm: Gradients are clipped to this norm.
        grad_accum_steps: Parts into which each process splits its batch, to save memory.
    """

    learning_rate: Probability = 1e-3
    weight_decay: Annotated[float, Range(0)] = 0.01
    max_grad_norm: Annotated[float, Range(1e-6)] = 1.0
    grad_accum_steps: Count = 1


@dataclass(frozen=True, slots=True)
class ScheduleConfig:
    """Length of a run, learning rate over it, and checkpoints.

    Args:
        steps: Optimizer steps, those of pretraining apart.
        epochs: Passes over the demonstrations, instead of `steps`.
        warmup_steps: Steps of the linear warm-up, at most a third of the run.
        decay_steps: Steps of the cosine decay; None is to the end of the run.
        final_learning_rate: Learning rate after the decay.
        checkpoint_every: Steps between checkpoints, each with a validation; those to keep or roll out are
            additional.
        keep_every: Steps between checkpoints that are kept; None keeps the latest and the best only.
    """

    steps: Count = 400
    epochs: Annotated[float, Range(0.001)] | None = None
    warmup_steps: Steps = 50
    decay_steps: Count | None = None
    final_learning_rate: Probability = 0.0
    checkpoint_every: Count = 100
    keep_every: Count | None = None


@dataclass(frozen=True, slots=True)
class RolloutConfig:
    """Rollouts of checkpoints in the simulator during training.

    Args:
        every: Steps between them; None leaves them out.
        episodes: Episodes per task.
        animate: Also log an animation of one episode of each task, with its prompt, to TensorBoard and
            Weights & Biases.
    """

    every: Count | None = None
    episodes: Count = 10
    animate: bool = True


@dataclass(frozen=True, slots=True)
class PretrainingConfig:
    """Contrastive pretraining of the crop encoder on rendered pairs.

    Args:
        steps: 0 leaves it out, and the image encoder is then trained by behaviour cloning. None is 400 for
            presets with an appearance embedding (nano, nano-bins, small), 0 for others and with `init_from`,
            whose encoder stays frozen unless `finetune_crop_encoder` is set. Any preset with object tokens
            can be pretrained.
        num_scenes: Scenes to render.
        batch_size: Object pairs a step.
        appearance_randomization_prob: Probability for each object of a random texture instead of one of the
            training partition, and of a random shape.
        hard_negative_prob: Probability for each movable object of a neighbour that differs in height, shade,
            texture or shape alone. Above 0 batches consist of whole scenes, and each scene has a rearranged
            view.
        box_jitter_px: Largest random shift of a crop's borders, in pixels of its 32.
        grayscale_prob: Probability for each object of a prompt image in neutral grey, which matches by shape.
        occlusion_prob: Probability for each object that bars of the background are painted over it.
        grating_prob: Probability that a random container is a grating, whose gaps are real.
        eared_prob: Probability that another random container has two ears, which its profile does without.
        ring_and_block_prob: Probability that a random movable shape is a ring or a block, round or square as
            containers are.
        attribute_loss_weight: Weight of the loss of attributes ("the same texture") on labelled pairs. Above
            0 it needs `model.attributes`, and captions of the pairs teach the words.
        finetune_crop_encoder: Whether behaviour cloning trains the crop encoder, which is slower: each step
            encodes its crops anew. None trains it unless this run, or that of the initial weights, has
            pretrained it.
    """

    steps: Steps | None = None
    num_scenes: Annotated[int, Range(2)] = 2500
    batch_size: Annotated[int, Range(2)] = 128
    appearance_randomization_prob: Probability = 0.0
    hard_negative_prob: Probability = 0.0
    box_jitter_px: Annotated[float, Range(0, 8)] = 0.0
    grayscale_prob: Probability = 0.0
    occlusion_prob: Probability = 0.0
    grating_prob: Probability = 0.0
    eared_prob: Probability = 0.0
    ring_and_block_prob: Probability = 0.0
    attribute_loss_weight: Annotated[float, Range(0, 100)] = 0.0
    finetune_crop_encoder: bool | None = None


@dataclass(frozen=True, slots=True)
class AugmentationConfig:
    """Augmentation of demonstrations, drawn anew for each demonstration and batch.

    Args:
        centre_picks: Move each demonstrated pick, a random point of its object, to the centre of the object's
            box, and the place with it; in validation, too. Pointer models read the pick from the object
            and have no use for it.
        false_positive_prob: Probability that a view of a step contains a false detection.
        inverse_dynamics_prob: Probability of replacing the prompt by "Follow this motion: frame … frame":
            1 for inverse-dynamics pretraining, less for in-context demonstrations. Validation uses the
            prompts of the tasks, unless it is 1.
        drop_unused_objects_prob: Probability of dropping each object that an inverse-dynamics demonstration
            does not use from the observations, and each that is left from the prompt frames. Needs true
            boxes.
        rename_objects_prob: Probability of naming prompt objects by novel nouns: "This is a wug {image}."
            Prompts with novel words of their own stay as they are.
        turn_comparisons_prob: Probability of asking without "less", with all comparisons turned round.
        shuffle_sentences_prob: Probability of shuffling the sentences that define novel words, and of keeping
            only some of several comparisons.
        unused_definitions_prob: Probability of inserting up to three sentences of another demonstration's
            prompt that define words which this prompt does not use.
        distractor_prob: Probability of inserting up to three distractors from another demonstration, in tasks
            whose prompts allow it.
        text_description_prob: Probability for each object image of a task's prompt of the text "red swirl
            letter A" in its place.
        text_prompt_prob: Probability of such texts in place of all object images of a task's prompt.
        synonym_prob: Probability that such a text names the object by an alias of the catalogue ("cube").
        paraphrase_prob: Probability of another phrasing of a task's prompt, of those in
            `tasks/paraphrases.yaml`.
        unknown_word_prob: Probability for each word of a task's prompt of the unknown token in its place, so
            that words which training lacks can be read past.
        shuffle_prompt_objects_prob: Probability of listing the objects of each prompt image in an order of
            its own; else an object has the same position in all frames.
    """

    centre_picks: bool = False
    false_positive_prob: Probability = 0.05
    inverse_dynamics_prob: Probability = 0.0
    drop_unused_objects_prob: Probability = 0.0
    rename_objects_prob: Probability = 0.0
    turn_comparisons_prob: Probability = 0.0
    shuffle_sentences_prob: Probability = 0.0
    unused_definitions_prob: Probability = 0.0
    distractor_prob: Probability = 0.0
    text_description_prob: Probability = 0.0
    text_prompt_prob: Probability = 0.0
    synonym_prob: Probability = 0.0
    paraphrase_prob: Probability = 0.0
    unknown_word_prob: Probability = 0.0
    shuffle_prompt_objects_prob: Probability = 0.0

    @property
    def describes_objects(self) -> bool:
        """Whether texts take the place of object images."""
        return self.text_description_prob > 0 or self.text_prompt_prob > 0


@dataclass(frozen=True, slots=True)
class RuntimeConfig:
    """Execution.

    Args:
        device: "auto" takes a GPU where there is one; or "cpu", "cuda", "cuda:1".
        precision: "float32", or "bfloat16" for matrix products, with weights in float32.
        processes: Processes that share each batch, on this machine; for several, see `torchrun`. On GPUs at
            most one on each.
        threads: CPU threads; equal numbers give equal weights.
        workers: Processes that render the scenes of pretraining and write object caches, before the steps;
            fewer where there is little to do. `openvima train` takes all CPUs.
        tensorboard: Also write TensorBoard events, if it is installed.
        wandb: Project of Weights & Biases to log to as well; empty logs nothing there.
    """

    device: str = "auto"
    precision: Literal["float32", "bfloat16"] = "float32"
    processes: Annotated[int, Range(1, 64)] = 1
    threads: Annotated[int, Range(1, 1024)] = 1
    workers: Annotated[int, Range(1, 1024)] = 1
    tensorboard: bool = True
    wandb: str = ""


@dataclass(frozen=True, slots=True)
class RunConfig:
    """Settings common to all training runs.

    Args:
        data: Folder of demonstrations, as `openvima generate` writes it.
        out: Run folder: checkpoints, settings, metrics.
        seed: Seed of weights, order and augmentation.
        force: Replace a run with other settings.
        allow_heldout: Also train on demonstrations of evaluation levels, such as those of the held-out tasks;
            results of the policy then say so.
        optimizer: The optimizer.
        schedule: Length, learning rate, checkpoints.
        runtime: Device, precision, processes.

    Raises:
        ConfigError: Settings are not allowed; the message names all of them.
    """

    data: Path
    out: Path
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    force: bool = False
    allow_heldout: bool = False
    optimizer: OptimizerConfig = OptimizerConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    runtime: RuntimeConfig = RuntimeConfig()

    def __post_init__(self) -> None:
        kinds = {name: options_of(hint) for name, hint in get_type_hints(type(self)).items()}
        paths, texts = ([name for name, kind in kinds.items() if each in kind] for each in (Path, str))
        settle(self, paths=paths, texts=texts)
        if problems := [*self._unknown(), *problems_of(self)]:
            raise ConfigError(" ".join(problems))

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> Self:
        """Make a configuration from settings by dotted name, such as "optimizer.learning_rate".

        Raises:
            ConfigError: A name is no setting, or a value is not allowed.
        """
        known = setting_types(cls)
        if problems := [unknown_name("setting", name, known) for name in settings if name not in known]:
            raise ConfigError(" ".join(problems))
        values: dict[str, dict[str, Any]] = {"": {}}
        for setting, value in settings.items():
            section, _, name = setting.rpartition(".")
            values.setdefault(section, {})[name] = value
        defaults: dict[str, Any] = {field.name: field.default for field in fields(cls)}
        return cls(**values.pop(""), **{name: replace(defaults[name], **own) for name, own in values.items()})

    def identity(self) -> dict[str, Any]:
        """Return the settings that identify the run, nested, as plain values."""
        values = {"": asdict(self)}
        values |= {name: section for name, section in values[""].items() if isinstance(section, dict)}
        for section, names in _NOT_IDENTITY.items():
            for name in names:
                values.get(section, {}).pop(name, None)
        return {name: str(v) if isinstance(v, Path) else v for name, v in values[""].items()}

    def _unknown(self) -> Iterator[str]:
        """Yield further problems."""
        yield from ()


@dataclass(frozen=True, slots=True)
class TrainingConfig(RunConfig):
    """One training run of a policy: contrastive pretraining, if the preset wants it, then behaviour cloning.

    Args:
        preset: Network and sizes, such as "nano" or "gato-nano" (`openvima policies` lists them); or
            "module:function" for a `Learner` of your own.
        init_from: Initial weights: another run, or other weights that `load_policy` takes.
        crops_from: Weights whose crop encoder to take, such as "openvima-vima", instead of pretraining one;
            it stays frozen as if this run had pretrained it.
        t5: Source of the T5 weights and tokenizer, for presets that use them: a folder, or an id on the
            Hugging Face Hub such as "t5-base".
        assets: Asset pack of pretraining: "procedural", the folder of the original one, or FILE.py:FUNCTION.
        model: Parts of the network that differ from the preset.
        object_cache: Folder of the object cache; None keeps it beside the demonstrations.
        loader: Batches and held-out demonstrations.
        rollout: Rollouts during training.
        pretraining: Contrastive pretraining.
        augmentation: Augmentation of demonstrations.
    """

    preset: str = "nano"
    model: ModelConfig = ModelConfig()
    init_from: str | None = None
    crops_from: str | None = None
    t5: str | None = None
    assets: str = "procedural"
    object_cache: Path | None = None
    loader: LoaderConfig = LoaderConfig()
    rollout: RolloutConfig = RolloutConfig()
    pretraining: PretrainingConfig = PretrainingConfig()
    augmentation: AugmentationConfig = AugmentationConfig()

    def _unknown(self) -> Iterator[str]:
        if not isinstance(self.preset, str) or self.preset in PRESETS or ":" in self.preset:
            return
        if self.preset in BUNDLED:
            yield f"preset is {self.preset!r}, which are weights; init_from takes them, beside their preset."
        elif self.preset not in own_policies():
            names = (*PRESETS, *own_policies())
            yield unknown_name("preset", self.preset, names, "`openvima policies` lists all.")
