"""Task options: validation, and their text form such as "num_distractors=3,rotate.difficulty=hard"."""

import inspect
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, get_args, get_type_hints

from openvima.catalog import Pool
from openvima.errors import ConfigError, echo, unknown_name
from openvima.tasks.registry import TaskSpec, list_tasks, task_spec
from openvima.tasks.table import TableSampler

MAX_OPTIONS_TEXT = 1000  # characters
MAX_DISTRACTORS = 6  # that find a place beside the other objects
_ENTRY = re.compile(r"(?:([\w-]+)\.)?([^\W\d]\w*)=([^\s,=]+)", re.ASCII)
_SCALARS: dict[type, str] = {bool: "true or false", int: "an integer", float: "a number", str: "a word"}

Difficulty = Literal["easy", "medium", "hard"]
"""Published results are all at "easy"."""


def check_difficulty(difficulty: str) -> None:
    """Check a difficulty.

    Raises:
        ConfigError: It is unknown.
    """
    if difficulty not in get_args(Difficulty):
        raise ConfigError(unknown_name("difficulty", difficulty, get_args(Difficulty)))


def check_count(name: str, count: object, *, high: int, low: int = 0) -> None:
    """Check that a number of objects is in `low` … `high`.

    Raises:
        ConfigError: It is not.
    """
    if isinstance(count, bool) or not isinstance(count, int) or not low <= count <= high:
        raise ConfigError(f"{name} is {count!r}; give an integer from {low} to {high}.")


def check_num_distractors(count: object, *, high: int = MAX_DISTRACTORS) -> None:
    """Check a number of distractors.

    Raises:
        ConfigError: It is not in 0 … `high`.
    """
    check_count("num_distractors", count, high=high)


def check_fraction(name: str, value: object) -> None:
    """Check that a number is in 0 … 1.

    Raises:
        ConfigError: It is not.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
        raise ConfigError(f"{name} is {value!r}; give a number from 0 to 1.")


def textures_by_difficulty(table: TableSampler, difficulty: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the textures of dragged objects and of bases.

    Args:
        table: Its pool is used; "medium" draws once.
        difficulty: "easy": the pool's; "medium": both from one of the two lists; "hard": swapped.
    """
    check_difficulty(difficulty)
    pool: Pool = table.pool
    dragged, base = pool.dragged_textures, pool.base_textures
    if difficulty == "hard":
        return base, dragged
    if difficulty == "medium":
        return (base, base) if table.rng.random() < 0.5 else (dragged, dragged)
    return dragged, base


@dataclass(frozen=True, slots=True)
class TaskOptions:
    """Options of the tasks of a run.

    Args:
        entries: Task (empty for all tasks that have the option), name and value of each; sorted.

    Example:
        >>> TaskOptions.parse("rotate.num_distractors=2, num_distractors=3").of(task_spec("rotate"))
        {'num_distractors': 2}
    """

    entries: tuple[tuple[str, str, str], ...] = ()

    @staticmethod
    def parse(text: str) -> "TaskOptions":
        """Read [TASK.]NAME=VALUE,…; whether tasks have the options is for `check` to say.

        Raises:
            ConfigError: The text has another form, is too long, or sets an option twice.
        """
        if not isinstance(text, str):
            raise ConfigError(f"task_options is {echo(repr(text))}; give text such as 'num_distractors=3'.")
        return _parse(text)

    def __str__(self) -> str:
        return ",".join(f"{task and task + '.'}{name}={value}" for task, name, value in self.entries)

    def of(self, spec: TaskSpec) -> dict[str, Any]:
        """Return the keyword arguments of one task; an option of this task overrides one of all tasks.

        Raises:
            ConfigError: A value is not of the option's type, or the task does not have one of its options.
        """
        options = {}
        for task, name, value in self.entries:
            if task == spec.name and name not in spec.options:
                raise ConfigError(unknown_name(f"option of task {task!r}:", name, spec.options))
            if task == spec.name or (not task and name in spec.options):
                options[name] = _convert(spec, name, value)
        return options

    def check(self, tasks: Sequence[str]) -> None:
        """Check that the tasks of a run have the options, and their types.

        Raises:
            UnknownTaskError: There is no such task.
            ConfigError: A task with an option is not in the run, no task of the run has an option, or a value
                is not of its type.
        """
        known = {name for task in tasks for name in task_spec(task).options}
        for task, name, _ in self.entries:
            if task and task_spec(task).name not in tasks:
                raise ConfigError(
                    f"task option {task}.{name}: this run has no {task}; its tasks are {', '.join(tasks)}."
                )
            if not task and name not in known:
                everywhere = {name for other in list_tasks() for name in task_spec(other).options}
                kind = "task option" if name not in everywhere else f"option of {', '.join(tasks)}:"
                raise ConfigError(unknown_name(kind, name, sorted(known)))
        for task in tasks:
            self.of(task_spec(task))


def option_descriptions(spec: TaskSpec) -> dict[str, str]:
    """Return what the docstring of a task's `sample` says of each option; empty where it says nothing."""
    descriptions = dict.fromkeys(spec.options, "")
    for entry in re.split(r"\n(?: {4})?(?=\w)", inspect.getdoc(spec.sample) or ""):
        name, _, text = entry.partition(": ")
        if name in descriptions:
            descriptions[name] = " ".join(text.split())
    return descriptions


@lru_cache
def _parse(text: str) -> TaskOptions:
    if len(text) > MAX_OPTIONS_TEXT:
        raise ConfigError(f"task_options has {len(text)} characters; at most {MAX_OPTIONS_TEXT} are allowed.")
    found: dict[tuple[str, str], str] = {}
    for entry in filter(None, (part.strip() for part in text.split(","))):
        match = _ENTRY.fullmatch(entry)
        if match is None or not entry.isprintable():
            raise ConfigError(
                f"task option {echo(repr(entry))} is not [TASK.]NAME=VALUE, such as num_distractors=3 or "
                "rotate.difficulty=hard."
            )
        key = (match[1] or "", match[2])
        if key in found:
            raise ConfigError(f"task option {echo(entry.partition('=')[0])} is given twice; give one value.")
        found[key] = match[3]
    return TaskOptions(tuple((task, name, found[task, name]) for task, name in sorted(found)))


def _convert(spec: TaskSpec, name: str, value: str) -> Any:
    """Convert a value to the type that the task declares, or else to that of the default."""
    default = spec.options[name]
    try:
        declared = get_type_hints(spec.sample).get(name, type(default))
    except NameError:  # of a type that only type checkers import
        declared = type(default)
    kinds = set(_scalars(declared))
    kind = next((kind for kind in _SCALARS if kind in kinds), str)
    is_list = isinstance(default, Sequence) and not isinstance(default, str)
    items = [_scalar(kind, item) for item in (value.split("+") if is_list else [value])]
    if None in items:
        several = ", or several with + between them" if is_list else ""
        raise ConfigError(
            f"option {name} of task {spec.name!r} is {echo(repr(value))}; give {_SCALARS[kind]}{several}."
        )
    return tuple(items) if is_list else items[0]


def _scalars(declared: Any) -> Iterator[type]:
    """Yield the scalar types within a type."""
    if declared in _SCALARS:
        yield declared
    for part in get_args(declared):
        yield from _scalars(part)


def _scalar(kind: type, text: str) -> bool | int | float | str | None:
    """Convert one value; None if it is not of the type."""
    if kind is bool:
        return {"true": True, "false": False}.get(text)
    if kind is str:
        return text
    try:
        number = kind(text)
    except ValueError:
        return None
    is_odd = kind is int and text != str(number)  # 03 is 3 in another spelling, so another setting
    return None if is_odd or not math.isfinite(number) else number
