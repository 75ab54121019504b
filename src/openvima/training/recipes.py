"""Recipes (named settings), and settings from files."""

from collections.abc import Mapping
from pathlib import Path
from reprlib import repr as short
from types import MappingProxyType
from typing import Annotated, Any, get_args, get_origin

from openvima.errors import ConfigError, InputFileError, unknown_name
from openvima.input_files import read_yaml
from openvima.policies.config_fields import options_of
from openvima.policies.presets import PRESETS
from openvima.training.config import TrainingConfig, flatten, setting_types

# VIMA, Jiang et al. 2023, with what later re-implementations report where the paper is silent: AdamW without
# decay, the rate falls to its end within the first half of the run.
_PAPER: Mapping[str, Any] = {
    "preset": "vima-200m",
    "schedule.epochs": 10,
    "loader.batch_size": 128,
    "optimizer.learning_rate": 1e-4,
    "schedule.final_learning_rate": 1e-7,
    "schedule.warmup_steps": 7000,
    "schedule.decay_steps": 17000,
    "optimizer.weight_decay": 0.0,
    "loader.validation_fraction": 1 / 13,
    "schedule.checkpoint_every": 1000,
    "runtime.precision": "bfloat16",
    "loader.num_workers": 4,
}
# MIDAS, Li et al. 2023: learning rates and batch sizes are not published, so they are VIMA's.
_MIDAS: Mapping[str, Any] = {**_PAPER, "preset": "midas-92m"}
_VARIED_PAIRS: Mapping[str, Any] = {
    "pretraining.appearance_randomization_prob": 0.4,
    "pretraining.hard_negative_prob": 0.4,
    "pretraining.box_jitter_px": 1.0,
    "pretraining.grayscale_prob": 0.3,
    "pretraining.occlusion_prob": 0.35,
    "pretraining.grating_prob": 0.4,
    "pretraining.eared_prob": 0.3,
    "pretraining.ring_and_block_prob": 0.3,
}
# The bundled openvima-small; docs/training.md has its history.
_SMALL: Mapping[str, Any] = {
    "preset": "small",
    "pretraining.steps": 4000,
    "pretraining.num_scenes": 8000,
    **_VARIED_PAIRS,
    "pretraining.attribute_loss_weight": 0.5,
    "schedule.steps": 3100,
    "loader.batch_size": 128,
    "loader.rerendered_prob": 0.4,
    "optimizer.learning_rate": 4e-4,
    "schedule.warmup_steps": 100,
    "augmentation.text_description_prob": 0.4,
    "augmentation.text_prompt_prob": 0.15,
    "augmentation.synonym_prob": 0.3,
    "augmentation.paraphrase_prob": 0.4,
    "augmentation.unknown_word_prob": 0.05,
    "augmentation.rename_objects_prob": 0.3,
    "augmentation.shuffle_sentences_prob": 0.3,
    "augmentation.shuffle_prompt_objects_prob": 1.0,
    "augmentation.distractor_prob": 0.6,
    "loader.validation_fraction": 0.02,
    "loader.validation_episodes": 500,
    "schedule.checkpoint_every": 250,
    "runtime.processes": 2,
}
# The architectures of the papers in size nano, on two cores; docs/train_vima.md has what they reach.
# Post-norm decoders collapse at twice this learning rate.
_PAPERS_FRAMES: Mapping[str, Any] = {
    "preset": "gato-nano",
    "schedule.steps": 8000,
    "loader.batch_size": 64,
    "loader.rerendered_prob": 0.4,
    # Of the tasks that take longest to learn; larger shares hold up the others. See
    # results/2026-11-28_papers.md.
    "loader.repeat_tasks": "novel_adj=3,pick_in_order_then_restore=4",
    "optimizer.learning_rate": 5e-4,
    "optimizer.weight_decay": 0.0,
    "schedule.warmup_steps": 200,
    "schedule.checkpoint_every": 500,
    "loader.validation_fraction": 0.02,
    "loader.validation_episodes": 500,
    "runtime.processes": 2,
}
# Crops that behaviour cloning alone trains do not tell textures apart, so they are pretrained by contrast.
_PAPERS: Mapping[str, Any] = {
    **_PAPERS_FRAMES,
    "preset": "vima-nano",
    "schedule.steps": 12000,
    "pretraining.steps": 4000,
    "pretraining.num_scenes": 8000,
    **_VARIED_PAIRS,
    "pretraining.finetune_crop_encoder": False,  # nor after --init-from
    "model.points": True,
    "augmentation.centre_picks": True,
    "augmentation.rename_objects_prob": 0.3,
    "augmentation.turn_comparisons_prob": 0.8,
    "augmentation.shuffle_sentences_prob": 0.3,
    "augmentation.unused_definitions_prob": 0.4,
    "augmentation.distractor_prob": 0.3,
}
_PAPERS_MIDAS: Mapping[str, Any] = {
    **_PAPERS,
    "preset": "midas-nano",
    "schedule.steps": 12000,  # each takes twice as long as one of VIMA
    # Otherwise it never learns which object an image of the prompt shows, nor the angle of `rotate`. See
    # results/2026-11-29_midas_first_tasks.md and results/2026-11-30_midas.md.
    "loader.first_tasks": "pick_in_order_then_restore,rotate,visual_manipulation",
    "loader.first_steps": 1000,
    "augmentation.inverse_dynamics_prob": 0.33,
    "augmentation.drop_unused_objects_prob": 0.5,  # `follow_motion` shows what moves alone
}
# What differs from the defaults of `TrainingConfig`, which are those of "nano".
RECIPES: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "paper": _PAPER,
        # 10,300 iterations is the longest pretraining of the paper; shorter ones helped less.
        "midas-pretrain": {
            **_MIDAS,
            "schedule.epochs": None,
            "schedule.steps": 10300,
            "schedule.warmup_steps": 1000,
            "schedule.decay_steps": None,
            "augmentation.inverse_dynamics_prob": 1.0,
        },
        "midas-finetune": _MIDAS,
        # The share of images that the paper replaces is not published: a half, as in mixed prompts.
        "midas-in-context": {
            **_MIDAS,
            "loader.exclude_tasks": "follow_motion,follow_order,twist",
            "augmentation.text_description_prob": 0.5,
        },
        # One GPU of 24 GB and a tenth of the data; the rate decays until the end.
        "workstation": {
            "preset": "vima-20m",
            "schedule.epochs": 10,
            "loader.batch_size": 128,
            "optimizer.grad_accum_steps": 4,
            "optimizer.learning_rate": 1e-4,
            "schedule.final_learning_rate": 1e-7,
            "schedule.warmup_steps": 1000,
            "optimizer.weight_decay": 0.0,
            "loader.bucket_batches": 20,
            "schedule.checkpoint_every": 500,
            "runtime.precision": "bfloat16",
            "loader.num_workers": 2,
        },
        "papers": _PAPERS,
        "papers-midas": _PAPERS_MIDAS,
        "papers-frames": _PAPERS_FRAMES,
        # A few cores and a few thousand demonstrations: minutes.
        "nano": {},
        "small": _SMALL,
    }
)


def default_recipe(preset: str | None) -> str:
    """Return the recipe for a preset.

    Returns:
        "small" for "small", "nano" for the pointer network nano, nano-bins and learners of your own; of the
        architectures of the papers in size nano "papers" for VIMA, "papers-midas" for MIDAS and
        "papers-frames" for those that take whole frames; else "paper".
    """
    if preset == "small":
        return preset
    if preset and (preset.startswith("nano") or preset not in PRESETS):
        return "nano"
    if preset and preset.endswith("-nano"):
        return {"vima-nano": "papers", "midas-nano": "papers-midas"}.get(preset, "papers-frames")
    return "paper"


def recipe_settings(name: str) -> dict[str, Any]:
    """Return the settings of a recipe that differ from the defaults, by dotted name.

    Raises:
        ConfigError: There is no such recipe.
    """
    if name not in RECIPES:
        raise ConfigError(unknown_name("recipe", name, RECIPES))
    return dict(RECIPES[name])


_CODE = ("preset", "loader.boxes", "assets")  # settings that may name a function as module:function


def read_settings(file: Path, *, trust_code: bool = False) -> dict[str, Any]:
    """Read settings from a YAML file, by dotted name: nested fields of `TrainingConfig` and their values.

    The `config.yaml` of a run folder is such a file, too: its part "training" counts.

    Args:
        file: The file.
        trust_code: Whether it may name code, as a learner or detector of your own.

    Raises:
        ConfigError: It is missing, no YAML, holds a name that is no setting, or names code.
    """
    try:
        values = read_yaml(file)
    except OSError as error:
        raise ConfigError(f"{file} cannot be read ({error.strerror}).") from None
    except InputFileError as error:
        raise ConfigError(str(error)) from None
    if isinstance(values, dict) and isinstance(values.get("training"), dict):
        values = values["training"]
    if not isinstance(values, dict):
        raise ConfigError(f"{file} must hold settings, one `name: value` a line.")
    values, known = flatten(values), setting_types(TrainingConfig)
    if problems := [unknown_name(f"setting in {file} called", n, known) for n in values if n not in known]:
        raise ConfigError(" ".join(problems))
    named = {name: str(values.get(name)) for name in _CODE}
    # "detector=FOLDER" names a detector.
    code = [f"{n} {short(v)}" for n, v in named.items() if ":" in v and not v.startswith("detector=")]
    if code and not trust_code:
        raise ConfigError(
            f"{file} names code to run: {', '.join(code)}. Nothing was executed. If you trust the file, add "
            "--trust-code."
        )
    return {name: _number(value, known[name]) for name, value in values.items()}


def _number(value: Any, hint: Any) -> Any:
    """Convert text to a number where a setting is one: YAML reads 1e-4, without a point, as text."""
    kinds = {get_args(each)[0] if get_origin(each) is Annotated else each for each in options_of(hint)}
    try:
        return float(value) if isinstance(value, str) and float in kinds else value
    except ValueError:  # reported by `problems_of`
        return value


def override(settings: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Override settings by others.

    Steps replace epochs. `init_from` comes with a trained crop encoder, so it resets pretraining to the
    default of the preset, which is then none, and shows no tasks first, unless the others set it as well.
    `crops_from` leaves pretraining out.
    Settings of the recipe `papers` that other image tokens or another head cannot have are dropped.
    """
    length = {"schedule.epochs": None} if "schedule.steps" in others else {}
    trained = {"pretraining.steps": None, "loader.first_steps": 0} if others.get("init_from") else {}
    if others.get("crops_from"):
        trained["pretraining.steps"] = 0
    tokens, unfit = others.get("model.image_tokens") or "objects", set[str]()
    if tokens != "objects":
        unfit |= {"model.points"}
    if tokens not in ("objects", "object-perceiver"):
        unfit |= _PAPERS.keys() - _PAPERS_FRAMES.keys()
    fit = {name: value for name, value in settings.items() if name not in unfit}
    return {**fit, **length, **trained, **others}
