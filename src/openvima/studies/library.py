"""The studies of the package, which `studies.yaml` describes, and those of users."""

import re
from collections.abc import Iterator, Mapping
from importlib import resources
from itertools import product
from string import Formatter
from types import MappingProxyType, SimpleNamespace
from typing import Any

import yaml

from openvima.env.config import EnvConfig
from openvima.errors import ConfigError, unknown_name
from openvima.evaluation.prompt_ablations import IN_CONTEXT_TASKS
from openvima.policies.presets import PUBLISHED, SIZE_NAMES
from openvima.report.published import leading_models, published_models
from openvima.studies.study import (
    L4_TASKS,
    NANO_POINTER,
    TRAINING_TASKS,
    Run,
    Study,
    StudyInputs,
    published_points,
)
from openvima.user_code import is_code, load_function

_DESCRIPTIONS: Mapping[str, dict[str, Any]] = yaml.safe_load(
    resources.files("openvima.studies").joinpath("studies.yaml").read_text(encoding="utf-8")
)
STUDIES: Mapping[str, str] = MappingProxyType({name: each["summary"] for name, each in _DESCRIPTIONS.items()})

# Options that not every study takes.
_TAKERS = {"policy": ("distractors", "corrupted-prompts"), "checkpoint": ("published",)}


def check_options(name: str, inputs: StudyInputs) -> None:
    """Check that a study takes the options; those of users take all.

    Raises:
        ConfigError: An option has no effect on the study.
    """
    given = {"policy": inputs.policies, "checkpoint": inputs.checkpoint}
    for option, takers in _TAKERS.items():
        if given[option] and name in STUDIES and name not in takers:
            raise ConfigError(f"study {name!r} takes no --{option}; {' and '.join(takers)} do.")
    if inputs.t5 is not None and inputs.scale.is_nano and name in STUDIES:
        raise ConfigError("scale nano has its own vocabulary and no T5; leave --t5 out.")


def make_study(name: str, inputs: StudyInputs) -> Study:
    """Return a study.

    Args:
        name: One of `STUDIES`, or FILE.py:FUNCTION or MODULE:FUNCTION, a function of `StudyInputs`.
        inputs: Scale and options.

    Raises:
        ConfigError: There is no such study, it lacks an option, or the function returns something else.
    """
    if is_code(name):
        study = load_function(name, what="study")(inputs)
        if not isinstance(study, Study):
            raise ConfigError(f"study is {name!r}, which returned a {type(study).__name__}; return a Study.")
        return study
    if name not in STUDIES:
        raise ConfigError(unknown_name("study", name, STUDIES))
    if name == "published":
        _check_published(inputs)
    values = _fill({k: v for k, v in _DESCRIPTIONS[name].items() if k != "summary"}, _names(inputs))
    runs = tuple(run if isinstance(run, Run) else Run(**run) for run in values.pop("runs"))
    tasks, evaluation = values.pop("tasks", ()), values.pop("evaluation", {})
    if evaluation.pop("compat", False):
        evaluation["env_config"] = EnvConfig(inputs.assets, compat=True)
    return Study(
        name,
        runs=runs,
        data=None if runs[0].policy else inputs.demonstrations(tasks),
        evaluation=inputs.evaluation(**evaluation),
        **values,
    )


def _check_published(inputs: StudyInputs) -> None:
    if inputs.checkpoint is None:
        raise ConfigError(
            "study published needs --checkpoint, the folder that `openvima policies convert 200M.ckpt FOLDER "
            "--tokenizer t5-base` writes."
        )
    if inputs.assets == "procedural":
        raise ConfigError(
            "study published needs --assets, a checkout of the original benchmark, or 'original' after "
            "`openvima assets import`."
        )


def _names(inputs: StudyInputs) -> dict[str, Any]:
    """What texts of `studies.yaml` can name."""
    tasks = (*TRAINING_TASKS, *L4_TASKS)
    whole = [model for model in published_models() if model.data_fraction == 1]
    sized = [model for model in whole if not model.aside]
    fewer = {(m.model, m.size) for m in published_models() if m.data_fraction < 1 and not m.aside}
    return {
        "inputs": inputs,
        "policies": inputs.policy_runs(),
        "num_tasks": len(inputs.scale.tasks),
        "all_tasks": tasks,
        "distractor_tasks": tuple(task for task in tasks if task != "pick_in_order_then_restore"),
        "in_context_tasks": IN_CONTEXT_TASKS,
        "left_out": ",".join(IN_CONTEXT_TASKS),
        "architectures": PUBLISHED,
        "sizes": [
            SimpleNamespace(name=size, parameters=1e6 * int(size.removesuffix("m")))
            for size in SIZE_NAMES[1 : SIZE_NAMES.index(inputs.scale.name) + 1]
        ],
        "size_ticks": {model.num_parameters: model.size for model in sized},
        "published_sizes": published_points(
            sized, series=lambda model: model.model, x=lambda model: model.num_parameters
        ),
        "published_fractions": published_points(
            (m for m in published_models() if (m.model, m.size) in fewer), x=lambda m: m.data_fraction
        ),
        "published_leading": published_points(leading_models()),
        "published_vima": published_points(m for m in whole if m.model == "VIMA"),
        "published_midas": published_points(
            (m for m in whole if m.model.startswith("MIDAS") and m.size == "92M"),
            x=lambda model: "autoregressive, residual",
        ),
    }


def _fill(value: Any, names: Mapping[str, Any]) -> Any:
    """Fill in names, and choose what holds for the scale."""
    if isinstance(value, list):
        return tuple(_fill(each, chosen) for each in value for chosen in _choices(each, names))
    if isinstance(value, str):
        named = re.fullmatch(r"\{([\w.]+)\}", value)
        return Formatter().get_field(named[1], (), names)[0] if named else value.format_map(names)
    if not isinstance(value, dict):
        return value
    inputs = names["inputs"]
    own = {**value, **value.get("nano" if inputs.scale.is_nano else "papers", {})}
    filled = {key: _fill(each, names) for key, each in own.items() if key not in ("nano", "papers", "for")}
    if (network := filled.pop("network", None)) is not None:
        recipe = filled.pop("recipe", None)
        filled = {**(NANO_POINTER if network == "pointer" else inputs.network(network, recipe)), **filled}
    return filled


def _choices(value: Any, names: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Names with those that an entry of a list is repeated for, in all combinations."""
    repeated = _fill(value.get("for", {}), names) if isinstance(value, dict) else {}
    for values in product(*repeated.values()):
        chosen = dict(zip(repeated, values, strict=True))
        yield {**names, **chosen}
