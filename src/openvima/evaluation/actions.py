"""Recorded actions of an evaluation: `actions.arrow`, one record a step, from which outcomes are replayed."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from openvima.atomic_io import atomic_write
from openvima.data.encoding import list_rows
from openvima.data.shard import DAMAGE_ERRORS
from openvima.env.tabletop import TabletopEnv
from openvima.errors import DatasetError, OracleError, one_line
from openvima.evaluation.results import Row
from openvima.evaluation.rollout_policies import Decision, Observation
from openvima.input_files import read_bytes
from openvima.scene import ACTION_SHAPES, Action
from openvima.scene.action import COMMAND_NAMES, END_EFFECTOR, PRIMITIVES, ToolCommand

ACTIONS_NAME = "actions.arrow"
_WIDTHS = {PRIMITIVES: sum(ACTION_SHAPES.values()), END_EFFECTOR: len(COMMAND_NAMES)}  # in their order
_SCHEMAS = {
    width: pa.schema([("seed", pa.int64()), ("action", pa.list_(pa.float32(), width))])
    for width in _WIDTHS.values()
}
_MAX_BYTES = 1 << 28  # five million steps

Steps = list[list[float]]  # the actions of one episode, 12 float32 numbers each, or 5 of a command


class ActionReplay:
    """A rollout policy that replays recorded actions; where none is left it gives an `OracleError`."""

    def __init__(self, actions: Sequence[np.ndarray]) -> None:
        self._actions = actions
        self._left: list[Iterator[Decision]] = []

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Start with the first actions; nothing is read from the environments."""
        self._left = [map(action_arrays, steps) for steps in self._actions]

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Give the next recorded action of each episode that is not over."""
        return [
            None if observation is None else next(steps, OracleError("no action is recorded"))
            for steps, observation in zip(self._left, observations, strict=True)
        ]


def write_actions(folder: Path, episodes: Iterable[tuple[int, Steps]], *, control: str = PRIMITIVES) -> str:
    """Write seed and actions of all episodes, in the order of `results.json`.

    Args:
        folder: Where to.
        episodes: Seed and steps of each.
        control: What a step is.

    Returns:
        SHA-256 of the recorded numbers, as hexadecimal text.
    """
    records = [(seed, step) for seed, steps in episodes for step in steps]
    seeds = np.array([seed for seed, _ in records], np.int64)
    width = _WIDTHS[control]
    numbers = np.array([step for _, step in records], np.float32).reshape(-1, width)
    table = pa.table([pa.array(seeds), list_rows(numbers)], schema=_SCHEMAS[width])
    with atomic_write(folder / ACTIONS_NAME) as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    return _digest(seeds, numbers)


def read_actions(folder: Path, rows: Iterable[Row]) -> tuple[list[list[np.ndarray]], str]:
    """Read the actions of an evaluation.

    Args:
        folder: The folder of the evaluation.
        rows: The rows of its `results.json`.

    Returns:
        For each row the actions of its episodes, shape (steps, 12 or 5), float32; and the
        SHA-256 of the recorded numbers.

    Raises:
        DatasetError: The file is missing, damaged, too large, or has steps of other episodes than the rows.
    """
    path = folder / ACTIONS_NAME
    try:
        table = pa.ipc.open_file(read_bytes(path, max_bytes=_MAX_BYTES)).read_all()
        width = next(width for width, schema in _SCHEMAS.items() if table.schema.equals(schema))
        seeds = table.column(0).to_numpy()
        numbers = table.column(1).combine_chunks().flatten().to_numpy(zero_copy_only=False)
    except FileNotFoundError:
        raise DatasetError(
            f"there is no {path}; evaluations of this version write it. Evaluate again with --force."
        ) from None
    except (StopIteration, *DAMAGE_ERRORS) as error:
        raise DatasetError(f"{path} is damaged ({one_line(error)}).") from None
    numbers = numbers.reshape(-1, width)
    outcomes = [outcome for row in rows for outcome in row.outcomes]
    counts = [max(0, outcome.steps) for outcome in outcomes]
    if not np.array_equal(seeds, np.repeat([outcome.seed for outcome in outcomes], counts)):
        raise DatasetError(f"{path} has other steps than results.json counts.")
    episodes = iter(np.split(numbers, np.cumsum(counts)[:-1]))
    return [[next(episodes) for _ in row.outcomes] for row in rows], _digest(seeds, numbers)


def numbers_of(action: Decision, control: str) -> list[float]:
    """Return the numbers of an action that was executed: 12, or 5 of a command."""
    given: Any = action
    if control == END_EFFECTOR:
        command = given.to_array() if isinstance(given, ToolCommand) else given
        return ToolCommand.from_array(command).to_array().tolist()
    primitive = given if isinstance(given, Action) else Action.from_arrays(given)
    return np.concatenate(list(primitive.to_arrays().values())).tolist()


def action_arrays(numbers: Sequence[float] | np.ndarray) -> dict[str, np.ndarray] | np.ndarray:
    """Return a recorded step as the arrays of an action, or as a command."""
    if len(numbers) == _WIDTHS[END_EFFECTOR]:
        return np.asarray(numbers, np.float32)
    parts = np.split(np.asarray(numbers, np.float32), np.cumsum(list(ACTION_SHAPES.values()))[:-1])
    return dict(zip(ACTION_SHAPES, parts, strict=True))


def _digest(seeds: np.ndarray, numbers: np.ndarray) -> str:
    return hashlib.sha256(seeds.astype("<i8").tobytes() + numbers.astype("<f4").tobytes()).hexdigest()
