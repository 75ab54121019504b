"""Task options: validation, and their text form such as "num_distractors=3,rotate.difficulty=hard"."""

import inspect
import json
import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from openvima.errors import ConfigError, echo
from openvima.tasks.registry import TaskSpec
from openvima.tasks.table import TableSampler

MAX_DISTRACTORS = 6  # that find a place beside the other objects
_ENTRY = re.compile(r"(?:([\w-]+)\.)?([^\W\d]\w*)=([^\s,=]+)", re.ASCII)

Difficulty = Literal["easy", "medium", "hard"]
"""Published results are all at "easy"."""
NumDistractors = Annotated[int, range(MAX_DISTRACTORS + 1)]
SomeDistractors = Annotated[int | None, range(MAX_DISTRACTORS + 1)]
FewDistractors = Annotated[int, range(4)]


def textures_by_difficulty(table: TableSampler, difficulty: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the textures of dragged objects and of bases.

    Args:
        table: Its pool is used; "medium" draws once.
        difficulty: "easy": the pool's; "medium": both from one of the two lists; "hard": swapped.
    """
    dragged, base = table.pool.dragged_textures, table.pool.base_textures
    if difficulty == "hard":
        return base, dragged
    if difficulty == "medium":
        return (base, base) if table.rng.random() < 0.5 else (dragged, dragged)
    return dragged, base


Options = dict[tuple[str, str], str]
"""Values of options by task, empty for all tasks that have the option, and name."""


def parse_options(text: str) -> Options:
    """Read [TASK.]NAME=VALUE,…, sorted; whether tasks have the options is for `check_task_options` to say.

    Raises:
        ConfigError: The text has another form, is too long, or sets an option twice.
    """
    if not isinstance(text, str):
        raise ConfigError(f"task_options is {echo(repr(text))}; give text such as 'num_distractors=3'.")
    found: Options = {}
    for entry in filter(None, (part.strip() for part in text.split(","))):
        match = _ENTRY.fullmatch(entry)
        if match is None:
            raise ConfigError(
                f"task option {echo(repr(entry))} is not [TASK.]NAME=VALUE, such as num_distractors=3 or "
                "rotate.difficulty=hard."
            )
        key = (match[1] or "", match[2])
        if key in found:
            raise ConfigError(f"task option {echo(entry.partition('=')[0])} is given twice; give one value.")
        found[key] = match[3]
    return dict(sorted(found.items()))


def options_text(options: Options) -> str:
    """Return options as `parse_options` reads them."""
    return ",".join(f"{task and task + '.'}{name}={value}" for (task, name), value in options.items())


def options_of(spec: TaskSpec, text: str) -> dict[str, Any]:
    """Return the keyword arguments of one task; an option of this task overrides one of all tasks.

    Example:
        >>> options_of(task_spec("rotate"), "rotate.num_distractors=2, num_distractors=3")
        {'num_distractors': 2}
    """
    return {
        name: _convert(spec, name, value)
        for (task, name), value in parse_options(text).items()
        if task == spec.name or (not task and name in spec.options)
    }


def option_descriptions(spec: TaskSpec) -> dict[str, str]:
    """Return what the docstring of a task's `sample` says of each option; empty where it says nothing."""
    descriptions = dict.fromkeys(spec.options, "")
    for entry in re.split(r"\n(?: {4})?(?=\w)", inspect.getdoc(spec.sample) or ""):
        name, _, text = entry.partition(": ")
        if name in descriptions:
            descriptions[name] = " ".join(text.split())
    return descriptions


def _convert(spec: TaskSpec, name: str, value: str) -> Any:
    """Read a number, true or false; anything else, and values of options that are text, stays text."""
    default = spec.options.get(name)
    if isinstance(default, str):
        return value
    is_list = isinstance(default, Sequence)
    items = tuple(map(_literal, value.split("+") if is_list else [value]))
    return items if is_list else items[0]


def _literal(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):  # a word, or brackets nested too deeply
        return text
