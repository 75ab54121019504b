"""Named settings: as the paper trains, for one workstation, and for a processor alone."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args, get_type_hints

import yaml

from openvima.errors import ConfigError, unknown_name
from openvima.training.config import TrainingConfig

# VIMA, Jiang et al. 2023, with what later re-implementations report where the paper is silent: AdamW without
# decay, the rate falls to its end within the first half of the run.
_PAPER: Mapping[str, Any] = {
    "preset": "vima-200m",
    "epochs": 10,
    "batch": 128,
    "learning_rate": 1e-4,
    "final_learning_rate": 1e-7,
    "warmup_steps": 7000,
    "decay_steps": 17000,
    "weight_decay": 0.0,
    "validation_share": 1 / 13,
    "checkpoint_every": 1000,
    "precision": "bfloat16",
    "loader_workers": 4,
}
# MIDAS, Li et al. 2023: rates and batches are not published, so they are VIMA's.
_MIDAS: Mapping[str, Any] = {**_PAPER, "preset": "midas-92m"}
# What differs from the defaults of `TrainingConfig`, which are those of "nano".
RECIPES: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "paper": _PAPER,
        # 10,300 iterations is the longest pretraining of the paper; shorter ones helped less.
        "midas-pretrain": {
            **_MIDAS,
            "epochs": None,
            "steps": 10300,
            "warmup_steps": 1000,
            "decay_steps": None,
            "motion_share": 1.0,
        },
        "midas-finetune": _MIDAS,
        # The paper mixes motions into the tasks for use in context and does not say how many.
        "midas-in-context": {**_MIDAS, "motion_share": 0.5},
        # One GPU of 24 GB and a tenth of the data; the rate falls until the end, which wastes nothing.
        "workstation": {
            "preset": "vima-20m",
            "epochs": 10,
            "batch": 128,
            "accumulate": 4,
            "learning_rate": 1e-4,
            "final_learning_rate": 1e-7,
            "warmup_steps": 1000,
            "weight_decay": 0.0,
            "bucket": 20,
            "checkpoint_every": 500,
            "precision": "bfloat16",
            "loader_workers": 2,
        },
        # A few cores and a few thousand demonstrations: minutes.
        "nano": {},
        # For a policy like the one that comes with the package; docs/training.md tells how that was made.
        "small": {
            "preset": "small",
            "pretraining_steps": 4000,
            "pretraining_scenes": 8000,
            "pretraining_random_looks": 0.4,
            "pretraining_twins": 0.4,
            "pretraining_box_shift": 1.0,
            "pretraining_grays": 0.3,
            "pretraining_gaps": 0.35,
            "steps": 3100,
            "batch": 128,
            "learning_rate": 4e-4,
            "warmup_steps": 100,
            "motion_share": 0.2,
            "bystander_share": 0.35,
            "naming_share": 0.3,
            "reordering_share": 0.3,
            "stranger_share": 0.6,
            "validation_share": 0.02,
            "validation_episodes": 500,
            "checkpoint_every": 250,
        },
    }
)


def default_recipe(preset: str | None) -> str:
    """Return the recipe for a preset.

    Returns:
        "small" for "small", "nano" for all nano networks and those of your own, else "paper".
    """
    if preset == "small":
        return preset
    return "nano" if preset and any(part in preset for part in ("nano", ":")) else "paper"


def recipe_settings(name: str) -> dict[str, Any]:
    """Return the settings of a recipe that differ from the defaults.

    Raises:
        ConfigError: There is no such recipe.
    """
    if name not in RECIPES:
        raise ConfigError(unknown_name("recipe", name, RECIPES))
    return dict(RECIPES[name])


def read_settings(file: Path) -> dict[str, Any]:
    """Read settings from a YAML file: names of `TrainingConfig` and their values.

    The `config.yaml` of a run folder is such a file, too: its part "training" counts.

    Raises:
        ConfigError: It is missing, no YAML, or holds a name that is no setting.
    """
    try:
        values = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file} cannot be read as YAML ({str(error).splitlines()[0]}).") from None
    if isinstance(values, dict) and isinstance(values.get("training"), dict):
        values = values["training"]
    if not isinstance(values, dict):
        raise ConfigError(f"{file} must hold settings, one `name: value` a line.")
    known = get_type_hints(TrainingConfig)
    problems = [
        unknown_name(f"setting in {file} called", name, known) for name in values if name not in known
    ]
    if problems:
        raise ConfigError(" ".join(problems))
    return {
        name: _converted(value, get_args(known[name]) or (known[name],)) for name, value in values.items()
    }


def overridden(settings: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Put other settings over some.

    Steps among them replace the epochs of a recipe; and weights to begin with bring a crop encoder along, so
    that pretraining is left to the preset, which then has none, unless they set it as well.
    """
    length = {"epochs": None} if "steps" in others else {}
    matching = {"pretraining_steps": None} if others.get("init") else {}
    return {**settings, **length, **matching, **others}


def _converted(value: Any, kinds: tuple[Any, ...]) -> Any:  # Any: what YAML holds, and types
    """Make paths and numbers of texts; YAML takes 1e-4, without a point, for a text."""
    if not isinstance(value, str) or not {Path, float} & set(kinds):
        return value
    try:
        return Path(value) if Path in kinds else float(value)
    except ValueError:  # the settings will say what it must be
        return value
