"""Recorded actions of an evaluation: `actions.arrow`, one record a step, from which outcomes are replayed."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from openvima.atomic_io import atomic_write
from openvima.data.shard import DAMAGE_ERRORS
from openvima.env.tabletop import DEFAULT_MODALITIES, TabletopEnv
from openvima.errors import ActionError, AnswerError, DatasetError, OracleError, one_line
from openvima.evaluation.results import Row
from openvima.evaluation.rollout_policies import Decision, Observation, RolloutPolicy
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


class ActionRecorder:
    """A rollout policy that records the valid actions of another, of the last episode of each environment."""

    def __init__(self, policy: RolloutPolicy) -> None:
        self._policy, self._control = policy, PRIMITIVES
        self._of_env: dict[TabletopEnv, Steps] = {}
        self._running: list[Steps] = []

    @property
    def steps(self) -> list[Steps]:
        """The actions of each episode, in the order in which the environments first began one."""
        return list(self._of_env.values())

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Start a batch of episodes."""
        self._control = envs[0].control
        self._running = [[] for _ in envs]
        self._of_env.update(zip(envs, self._running, strict=True))
        self._policy.begin(envs)

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Pass on the decisions, and record those that are actions."""
        decisions = self._policy.decide(observations)
        for steps, observation, decision in zip(self._running, observations, decisions, strict=False):
            if observation is not None and (numbers := _numbers(decision, self._control)):
                steps.append(numbers)
        return decisions

    @property
    def near_ties(self) -> Sequence[bool]:
        """Those of the policy."""
        return getattr(self._policy, "near_ties", ())

    @property
    def modalities(self) -> tuple[str, ...]:
        """What the policy asks observations to hold."""
        return getattr(self._policy, "modalities", DEFAULT_MODALITIES)


class ActionReplay:
    """A rollout policy that replays recorded actions; where none is left it gives an `OracleError`."""

    def __init__(self, actions: Sequence[np.ndarray]) -> None:
        self._actions = actions
        self._left: list[Iterator[np.ndarray]] = []

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Start with the first actions; nothing is read from the environments."""
        self._left = [iter(steps) for steps in self._actions]

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Give the next recorded action of each episode that is not over."""
        return [
            None if observation is None else _next(steps)
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
    column = pa.FixedSizeListArray.from_arrays(pa.array(numbers.reshape(-1)), width)
    with atomic_write(folder / ACTIONS_NAME) as sink, pa.ipc.new_file(sink, _SCHEMAS[width]) as writer:
        writer.write_table(pa.table([pa.array(seeds), column], schema=_SCHEMAS[width]))
    return _digest(seeds, numbers)


def read_actions(folder: Path, rows: Iterable[Row]) -> tuple[dict[int, list[np.ndarray]], str]:
    """Read the actions of an evaluation.

    Args:
        folder: The folder of the evaluation.
        rows: The rows of its `results.json`.

    Returns:
        For the index of each row the actions of its episodes, shape (steps, 12 or 5), float32; and the
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
    return {i: [next(episodes) for _ in row.outcomes] for i, row in enumerate(rows)}, _digest(seeds, numbers)


def _numbers(decision: Decision, control: str) -> list[float]:
    if decision is None or isinstance(decision, OracleError | AnswerError):
        return []
    try:
        if control == END_EFFECTOR:
            given = decision.to_array() if isinstance(decision, ToolCommand) else decision
            return ToolCommand.from_array(given).to_array().tolist()
        action = decision if isinstance(decision, Action) else Action.from_arrays(decision)  # type: ignore[arg-type]
    except ActionError:
        return []
    return np.concatenate(list(action.to_arrays().values())).tolist()


def _next(steps: Iterator[np.ndarray]) -> Decision:
    step = next(steps, None)
    return OracleError("no action is recorded") if step is None else action_arrays(step)


def action_arrays(numbers: Sequence[float] | np.ndarray) -> dict[str, np.ndarray] | np.ndarray:
    """Return a recorded step as the arrays of an action, or as a command."""
    if len(numbers) == _WIDTHS[END_EFFECTOR]:
        return np.asarray(numbers, np.float32)
    parts = np.split(np.asarray(numbers, np.float32), np.cumsum(list(ACTION_SHAPES.values()))[:-1])
    return dict(zip(ACTION_SHAPES, parts, strict=True))


def _digest(seeds: np.ndarray, numbers: np.ndarray) -> str:
    return hashlib.sha256(seeds.astype("<i8").tobytes() + numbers.astype("<f4").tobytes()).hexdigest()
