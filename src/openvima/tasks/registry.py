"""Registry of tasks: each task file registers its `sample` function."""

import functools
import importlib
import importlib.metadata
import inspect
import itertools
import json
import os
import pkgutil
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from openvima.catalog import LEVELS, Level, Pool, levels_of, pool
from openvima.catalog.partitions import PACKAGE_TASKS, PUBLISHED_LEVELS
from openvima.errors import (
    ConfigError,
    UnknownTaskError,
    brief_repr,
    echo,
    unknown_name,
)
from openvima.scene import END_EFFECTORS, EndEffector, Problem
from openvima.user_code import load_entry_point, load_file

TASK_FILES_VARIABLE = "OPENVIMA_TASK_FILES"
ENTRY_POINTS = "openvima.tasks"
HELD_OUT = "heldout"  # stands for the tasks that are held out, as "all" does for all
EXTRA_STEPS = 2  # of a policy beyond the oracle's
MAX_EPISODE_STEPS = 20  # of a policy; the longest of the 17 tasks has 16
_NAME = re.compile(r"\w[\w-]{0,99}", re.ASCII)  # file names and task options hold it
SampleFunction = Callable[..., Problem]  # (table, *, options with defaults) -> Problem


@dataclass(frozen=True, slots=True)
class TaskSpec:
    """Description of a task.

    Args:
        name: Name as in "rotate".
        families: Groups of the paper under which results are reported, as in "visual_reasoning".
        template: The prompt with its slots.
        end_effector: "suction" or "spatula".
        pools: Objects and textures at each level where the task is defined.
        oracle_max_steps: Step limit of the oracle.
        summary: First line of the task file's docstring.
        sample: Samples a `Problem` with a `TableSampler`; keyword arguments are the task's options.
        distractors_allowed: Whether prompt and goals stay unambiguous with more objects on the table, so that
            training may insert distractors.
    """

    name: str
    families: tuple[str, ...]
    template: str
    end_effector: EndEffector
    pools: Mapping[Level, Pool]
    oracle_max_steps: int
    summary: str
    sample: SampleFunction
    distractors_allowed: bool = False

    __repr__ = brief_repr

    @property
    def levels(self) -> tuple[Level, ...]:
        """Levels at which the task is defined, "train" first."""
        return tuple(self.pools)

    @property
    def max_steps(self) -> int:
        """Step limit of a policy: two more than the oracle's."""
        return self.oracle_max_steps + EXTRA_STEPS

    @property
    def options(self) -> dict[str, Any]:
        """Names and defaults of the task's options."""
        parameters = inspect.signature(self.sample).parameters.values()
        return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}

    def check_options(self, options: Mapping[str, object], others: Sequence[str] = ()) -> None:
        """Check the names of options, and values where the annotation says which are allowed.

        These are `Literal`, `bool` with or without None, and `Annotated[int, range(n)]`.

        Args:
            options: Names and values.
            others: Names of options that a caller takes besides, to be suggested.

        Raises:
            ConfigError: The task has no such option, or its value is not allowed.
        """
        for name, value in options.items():
            if name not in self.options:
                known = [*others, *self.options]
                hint = f"Allowed: {', '.join(known)}."
                raise ConfigError(unknown_name(f"option of task {self.name!r}:", name, known, hint))
            parameter = inspect.signature(self.sample).parameters[name]
            annotation = parameter.annotation
            numbers = getattr(annotation, "__metadata__", (None,))[0]
            if value is parameter.default:
                continue
            if get_origin(annotation) is Literal and value not in get_args(annotation):
                raise ConfigError(unknown_name(name, value, get_args(annotation)))
            if annotation in (bool, bool | None) and not isinstance(value, bool):
                raise ConfigError(f"{name} is {value!r}; give true or false.")
            if isinstance(numbers, range) and (type(value) is not int or value not in numbers):
                raise ConfigError(f"{name} is {value!r}; give an integer from 0 to {numbers[-1]}.")

    def checked_level(self, level: str | None) -> Level:
        """Return the level, or the first one of the task for None.

        Raises:
            ConfigError: There is no such level, or the task is not defined there.
        """
        for known in self.levels:
            if level is None or level == known:
                return known
        if level not in LEVELS:
            raise ConfigError(unknown_name("level", str(level), LEVELS))
        raise ConfigError(
            f"task {self.name!r} is not defined at level {level}; use {', '.join(self.levels)}."
        )

    def pool(self, level: str) -> Pool:
        """Return the objects and textures at a level.

        Raises:
            ConfigError: There is no such level, or the task is not defined there.
        """
        return self.pools[self.checked_level(level)]


_TASKS: dict[str, TaskSpec] = {}
_WATCHERS: list[Callable[[str], None]] = []


def register_task(
    name: str,
    *,
    family: str | tuple[str, ...],
    template: str,
    oracle_max_steps: int,
    end_effector: EndEffector = "suction",
    pools: Mapping[Level, Pool] | None = None,
    distractors_allowed: bool = False,
    summary: str | None = None,
) -> Callable[[SampleFunction], SampleFunction]:
    """Register a task; decorates its `sample` function.

    Code that runs again, as a cell of a notebook or a reloaded module, replaces its own task.

    Args:
        name: Name of the task: up to 100 letters, digits, "_" and "-", of ASCII.
        family: Group of the paper under which results are reported, as in "visual_reasoning"; or several.
        template: The prompt with its slots.
        oracle_max_steps: Step limit of the oracle.
        end_effector: Tool of the arm.
        pools: Objects and textures at each level; by default those of the catalogue, which has tasks of the
            package only.
        distractors_allowed: See `TaskSpec`.
        summary: One sentence; by default the first line of the module's docstring.

    Returns:
        The decorator, which returns the function unchanged.

    Raises:
        ConfigError: Another module registered the name, or it is no plain name, there are no pools, one is of
            no level, there is no such end effector, or episodes would have more than 20 steps.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ConfigError(
            f"a task is named {echo(repr(name))}; give 1 to 100 letters, digits, '_' and '-', as 'my_task'."
        )
    if end_effector not in END_EFFECTORS:
        kind = f"end effector for task {name!r}:"
        raise ConfigError(unknown_name(kind, end_effector, END_EFFECTORS))
    check_steps(name, oracle_max_steps)
    if not pools and name not in PACKAGE_TASKS:
        raise ConfigError(f"task {name!r} has no pools; give objects and textures of a level at least.")
    for level in pools or ():
        if level not in LEVELS:
            raise ConfigError(f"pools of task {name!r}: {unknown_name('level', level, LEVELS)}")

    def register(sample: SampleFunction) -> SampleFunction:
        known = _TASKS.get(name)
        if known is not None and not _is_of_same_module(known.sample, sample):
            raise ConfigError(
                f"task {name!r} is registered twice, by {known.sample.__module__} and {sample.__module__}; "
                "task names are unique."
            )
        _TASKS[name] = TaskSpec(
            name=name,
            families=(family,) if isinstance(family, str) else tuple(family),
            template=template,
            end_effector=end_effector,
            pools=pools or {level: pool(name, level) for level in levels_of(name)},
            oracle_max_steps=oracle_max_steps,
            summary=summary or _summary(sample),
            sample=sample,
            distractors_allowed=distractors_allowed,
        )
        for watch in _WATCHERS:
            watch(name)
        return sample

    return register


def watch_tasks(watch: Callable[[str], None]) -> None:
    """Have a function called with the name of each task that is registered from now on."""
    if watch not in _WATCHERS:
        _WATCHERS.append(watch)


def _is_of_same_module(one: SampleFunction, other: SampleFunction) -> bool:
    """Whether two functions come from one module, or from one file that was imported under two names."""
    codes = (getattr(sample, "__code__", None) for sample in (one, other))
    files = [code and code.co_filename for code in codes]
    return one.__module__ == other.__module__ or (files[0] == files[1] and Path(files[0] or "").is_file())


def check_steps(task: str, oracle_max_steps: int) -> None:
    """Check the step limit of a task or of one of its episodes.

    Raises:
        ConfigError: It is not an integer from 1 to 18, two steps below the longest episode.
    """
    most = MAX_EPISODE_STEPS - EXTRA_STEPS
    if type(oracle_max_steps) is not int or not 1 <= oracle_max_steps <= most:
        raise ConfigError(
            f"oracle_max_steps of task {task!r} is {oracle_max_steps!r}; give an integer from 1 to {most}: "
            f"a policy has {EXTRA_STEPS} steps more, and an episode at most {MAX_EPISODE_STEPS}."
        )


def _summary(sample: SampleFunction) -> str:
    """First line of the task file's docstring, without the name before the colon."""
    module = inspect.getmodule(sample)
    first = ((module and module.__doc__) or "").partition("\n")[0]
    return first.partition(": ")[2] or first


def task_spec(name: str) -> TaskSpec:
    """Return a registered task.

    Raises:
        UnknownTaskError: There is no such task; the message suggests the nearest name.
    """
    _load_task_files()
    try:
        return _TASKS[name]
    except (KeyError, TypeError):
        hint = f"`openvima tasks` lists all {len(_TASKS)}; {TASK_FILES_VARIABLE} names files of your own."
        raise UnknownTaskError(unknown_name("task", name, _TASKS, hint)) from None


def list_tasks() -> tuple[str, ...]:
    """Names of all tasks, in alphabetical order."""
    _load_task_files()
    return tuple(sorted(_TASKS))


def tasks_of(level: str | None) -> tuple[str, ...]:
    """Names of the tasks that are defined at a level, in alphabetical order; of all for None.

    Raises:
        ConfigError: There is no such level.
    """
    if level is not None and level not in LEVELS:
        raise ConfigError(unknown_name("level", level, LEVELS))
    return tuple(task for task in list_tasks() if level is None or level in task_spec(task).levels)


def held_out_tasks() -> tuple[str, ...]:
    """Names of the tasks that are undefined at level "train", which policies meet in evaluation only."""
    return tuple(task for task in list_tasks() if "train" not in task_spec(task).levels)


def named_tasks(names: Sequence[str]) -> tuple[str, ...]:
    """Replace "heldout" in a list of tasks by the names of those of L4; drop repeated names."""
    held_out = [task for task in held_out_tasks() if set(task_spec(task).levels) & set(PUBLISHED_LEVELS)]
    parts = (held_out if name == HELD_OUT else (name,) for name in names)
    return tuple(dict.fromkeys(itertools.chain.from_iterable(parts)))


@functools.cache
def _load_task_files() -> None:
    """Import all modules of this package, then entry points and files of users."""
    for module in pkgutil.iter_modules([str(Path(__file__).parent)], f"{__package__}."):
        if not module.name.endswith(".kernels"):  # Numba, imported when an episode is sampled
            importlib.import_module(module.name)
    for entry_point in importlib.metadata.entry_points(group=ENTRY_POINTS):
        load_entry_point(entry_point)
    for path in filter(None, os.environ.get(TASK_FILES_VARIABLE, "").split(os.pathsep)):
        load_file(Path(path), what=TASK_FILES_VARIABLE)


ORACLE_FILE = "oracle_success.json"


def oracle_record(task: str) -> Mapping[str, Mapping[str, int]]:
    """Return the number of evaluation episodes of a task that the oracle solved.

    Args:
        task: Name of the task.

    Returns:
        Level to {"episodes", "successes"}; empty for a task without a measurement. `benchmarks/oracle.py`
        writes the record.
    """
    record = (files("openvima.tasks") / ORACLE_FILE).read_text(encoding="utf-8")
    return json.loads(record)["tasks"].get(task, {})
