"""Sub-environments of a vector environment: checks before anything moves, steps, and infos in one.

Gymnasium's `SyncVectorEnv` gathers all observations after a step and copies them twice; here each is written
once, to its row of a batch, while it is in the CPU's cache.
"""

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from openvima.errors import ActionError, ConfigError, EpisodeError
from openvima.scene import ACTION_SHAPES, WORKSPACE_LOW, Action
from openvima.scene.action import COMMAND_NAMES, PRIMITIVES, ToolCommand, is_valid_batch
from openvima.tasks.sampling import checked_seed

RESET_MASK = "reset_mask"  # Gymnasium's option: which sub-environments to reset, shape (N,), bool


class ActionValidator:
    """Validates the resets and actions of all sub-environments before any of them moves.

    Gymnasium does not: its synchronous kind steps the environments before the first invalid action and not
    those after it, and in its asynchronous kind an invalid action or seed ends a worker.

    Args:
        num_envs: Number of sub-environments.
        autoreset_mode: With "Disabled", a sub-environment whose episode is over needs a `reset`.
        control: What an action is: "primitives" or "end_effector".
    """

    def __init__(self, num_envs: int, autoreset_mode: AutoresetMode, control: str = PRIMITIVES) -> None:
        self.num_envs, self._control = num_envs, control
        self._waits_for_reset = autoreset_mode is AutoresetMode.DISABLED
        self._needs_reset = np.ones(num_envs, dtype=bool)
        self._reset_mask = np.zeros(num_envs, dtype=bool)

    def check_reset(self, seed: object, options: Mapping[str, Any] | None) -> list[int | None]:
        """Check the seeds and options of a reset.

        Args:
            seed: None, a number k (then sub-environment i gets k + i), or one number or None for each.
            options: None, or a mapping with "reset_mask" or nothing.

        Returns:
            The seed of each sub-environment, or None.

        Raises:
            ConfigError: A seed or an option is not allowed, or there are not as many seeds as environments.
        """
        if seed is None:
            seeds: list[int | None] = [None] * self.num_envs
        elif isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
            seeds = [None if entry is None else checked_seed(entry) for entry in seed]
        else:
            seeds = [checked_seed(checked_seed(seed) + index) for index in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ConfigError(f"got {len(seeds)} seeds for {self.num_envs} sub-environments; give one each.")
        mask = reset_option(options, RESET_MASK)
        self._reset_mask = np.ones(self.num_envs, dtype=bool) if mask is None else _checked_mask(mask, seeds)
        return seeds

    def begin_reset(self) -> None:
        """Record that the reset checked last begins; should it fail, some episodes are gone."""
        self._needs_reset |= self._reset_mask

    def record_reset(self) -> None:
        """Record that the reset checked last was executed."""
        self._needs_reset &= ~self._reset_mask

    def check_step(self, actions: object) -> None:
        """Check the actions of a step, and that every sub-environment has a running episode.

        Raises:
            EpisodeError: A sub-environment has no running episode.
            ActionError: An action is invalid; all problems are in one message. Nothing was moved.
        """
        if self._needs_reset.any():
            waiting = ", ".join(map(str, np.flatnonzero(self._needs_reset)))
            how = "reset()" if self._needs_reset.all() else f"reset(options={{'{RESET_MASK}': mask}})"
            raise EpisodeError(f"sub-environments {waiting} have no running episode; call {how} first.")
        is_primitive = self._control == PRIMITIVES
        if is_primitive and isinstance(actions, Mapping) and is_valid_batch(actions, self.num_envs):
            return
        places: dict[str, list[int]] = {}
        check = Action.from_arrays if is_primitive else ToolCommand.from_array
        rows = (_rows if is_primitive else _commands)(actions, self.num_envs)
        for index, action in enumerate(rows):
            try:
                check(action)
            except ActionError as error:
                places.setdefault(str(error).removesuffix(" Nothing was moved."), []).append(index)
        if places:
            problems = [f"sub-environment {', '.join(map(str, at))}: {text}" for text, at in places.items()]
            raise ActionError(" ".join(problems) + " Nothing was moved.")

    def begin_step(self) -> None:
        """Record that the step checked last begins; should it fail, some episodes are a step ahead."""
        self._needs_reset[:] = True

    def record_step(self, is_over: np.ndarray) -> None:
        """Record that the step was executed, and which episodes ended in it, shape (num_envs,), bool."""
        self._needs_reset = is_over & self._waits_for_reset


def reset_option(options: object, name: str) -> Any:
    """Return the one option that a reset takes, or None.

    Args:
        options: None, or a mapping with the option or nothing.
        name: The option.

    Raises:
        ConfigError: The options are no mapping, or there is another one.
    """
    if not isinstance(options, Mapping | None):
        raise ConfigError(f"options is a {type(options).__name__}; give None or a mapping with {name!r}.")
    if unknown := set(options or ()) - {name}:
        raise ConfigError(f"reset has no option {', '.join(sorted(map(str, unknown)))}; it takes {name!r}.")
    return (options or {}).get(name)


def stack_actions(actions: Sequence[Mapping[str, Any] | Action | None]) -> dict[str, np.ndarray]:
    """Stack one action for each sub-environment into the batch for `step` of a vector environment.

    Args:
        actions: What a policy's `act` returns. None becomes a placeholder action in a corner of
            the table, for sub-environments whose action does not matter.

    Returns:
        The four keys, each array with one row an action, float32.

    Raises:
        ActionError: An action lacks a key, or an array has the wrong length.
    """
    corner = Action(WORKSPACE_LOW, WORKSPACE_LOW)
    rows = [corner if action is None else action for action in actions]
    arrays = []
    for index, row in enumerate(rows):
        try:
            arrays.append((row if isinstance(row, Action) else Action.from_arrays(row)).to_arrays())
        except ActionError as error:
            raise ActionError(f"action {index}: {error}") from None
    return {key: np.stack([array[key] for array in arrays]) for key in ACTION_SHAPES}


def _rows(actions: object, num_envs: int) -> list[dict[str, Any]]:
    """Split a batch of actions."""
    if not isinstance(actions, Mapping):
        keys, given = ", ".join(ACTION_SHAPES), type(actions).__name__
        raise ActionError(
            f"actions are one mapping with keys {keys} and a row for each sub-environment, not {given}. "
            "`stack_actions` makes it from a list. Nothing was moved."
        )
    for key, value in actions.items():
        length = len(value) if hasattr(value, "__len__") else None
        if key in ACTION_SHAPES and length != num_envs:
            given = "no rows" if length is None else f"{length} rows"
            raise ActionError(
                f"{key} has {given}; it must have one for each of the {num_envs} sub-environments, shape "
                f"({num_envs}, {ACTION_SHAPES[key]}). Nothing was moved."
            )
    known = {key: value for key, value in actions.items() if key in ACTION_SHAPES}
    others = {key: value for key, value in actions.items() if key not in ACTION_SHAPES}
    return [{key: value[index] for key, value in known.items()} | others for index in range(num_envs)]


def _commands(actions: object, num_envs: int) -> np.ndarray:
    """Split a batch of commands of the tool."""
    shape = (num_envs, len(COMMAND_NAMES))
    if not isinstance(actions, np.ndarray) or actions.shape != shape:
        given = f"of shape {actions.shape}" if isinstance(actions, np.ndarray) else type(actions).__name__
        raise ActionError(f"actions are an array of shape {shape}, not {given}. Nothing was moved.")
    return actions


def _checked_mask(mask: object, seeds: Sequence[int | None]) -> np.ndarray:
    if (
        not isinstance(mask, np.ndarray)
        or mask.dtype != bool
        or mask.shape != (len(seeds),)
        or not mask.any()
    ):
        raise ConfigError(
            f"option '{RESET_MASK}' is {mask!r}; give an array of shape ({len(seeds)},), dtype bool, with at "
            "least one True."
        )
    return mask


Info = Mapping[str, Any]


class SubEnvironments:
    """Environments that are stepped in turn.

    Args:
        envs: The environments.
        autoreset_mode: When the next episode begins.
        observations: Batch that observations are written to, one row for each environment.
    """

    def __init__(
        self, envs: Sequence[gymnasium.Env], autoreset_mode: AutoresetMode, observations: Any
    ) -> None:
        self.envs = envs
        self._mode = autoreset_mode
        self._observations = observations
        self.is_over = np.zeros(len(envs), dtype=bool)
        self._was_seeded = np.ones(len(envs), dtype=bool)  # the last reset; the next one may be as well
        self._is_prepared = np.zeros(len(envs), dtype=bool)

    def reset(self, seeds: Sequence[int | None], mask: np.ndarray | None) -> list[Info | None]:
        """Start episodes where the mask is true, or in all; return the infos of these."""
        infos: list[Info | None] = [None] * len(self.envs)
        for index, seed in enumerate(seeds):
            if mask is None or mask[index]:
                infos[index] = self._reset(index, seed)
        return infos

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Info | None]]:
        """Take a step, or start an episode where the last one is over and the mode says so.

        Returns:
            Rewards, shape (N,), float64; terminated and truncated, shape (N,), bool; infos.
        """
        rewards = np.zeros(len(self.envs))
        terminated, truncated = np.zeros((2, len(self.envs)), dtype=bool)
        infos: list[Info | None] = []
        for index, env in enumerate(self.envs):
            if self._mode is AutoresetMode.NEXT_STEP and self.is_over[index]:
                infos.append(self._reset(index, None))
                continue
            result = env.step(rows(actions, index))
            observation, rewards[index], terminated[index], truncated[index], info = result
            if self._mode is AutoresetMode.SAME_STEP and (terminated[index] or truncated[index]):
                info = {"final_obs": observation, "final_info": info, **self._reset(index, None)}
            else:
                _write(observation, self._observations, index)
            infos.append(info)
        self.is_over = terminated | truncated
        return rewards, terminated, truncated, infos

    def prepare(self) -> bool:
        """Build one episode ahead of a reset without a seed that is certain or likely to come.

        Returns:
            Whether there was one to build.
        """
        is_certain = self.is_over & (self._mode is AutoresetMode.NEXT_STEP)
        is_wanted = (is_certain | ~self._was_seeded) & ~self._is_prepared
        if not is_wanted.any():
            return False
        index = int(np.argmax(is_wanted * (1 + is_certain)))
        self._is_prepared[index] = True
        with contextlib.suppress(Exception):  # the reset will raise it, or the environment is of another kind
            self.envs[index].get_wrapper_attr("prepare")()
        return True

    def _reset(self, index: int, seed: int | None) -> Info:
        self._was_seeded[index], self._is_prepared[index] = seed is not None, False
        observation, info = self.envs[index].reset(seed=seed)
        _write(observation, self._observations, index)
        self.is_over[index] = False
        return info


def rows(batch: Any, which: int | slice) -> Any:
    """Return one row, or consecutive ones, of an array or of nested mappings of arrays."""
    if isinstance(batch, Mapping):
        return {key: rows(values, which) for key, values in batch.items()}
    return batch[which]


def _write(observation: Any, batch: Any, index: int) -> None:
    """Write an observation to its row."""
    if isinstance(observation, Mapping):
        for key, value in observation.items():
            _write(value, batch[key], index)
    else:
        batch[index] = observation


def batch_infos(infos: Sequence[Info | None]) -> dict[str, Any]:
    """Join infos as Gymnasium does, column by column.

    Args:
        infos: One for each environment, or None.

    Returns:
        For every key the values of all environments, and with "_" before the key which of them have one.
        Numbers and arrays are in one array, 0 where there is none; the values of a dictionary are batches.
    """
    batch: dict[str, Any] = {}
    for key in dict.fromkeys(key for info in infos if info for key in info):
        values = {index: info[key] for index, info in enumerate(infos) if info is not None and key in info}
        some = next(iter(values.values()))
        if isinstance(some, dict) and key != "final_obs":
            batch[key] = batch_infos([values.get(index) for index in range(len(infos))])
        else:
            batch[key] = _blank(some, len(infos))
            for index, value in values.items():
                batch[key][index] = value
        batch[f"_{key}"] = np.isin(np.arange(len(infos)), list(values))
    return batch


def _blank(value: Any, num_envs: int) -> np.ndarray:
    if isinstance(value, np.ndarray):
        return np.zeros((num_envs, *value.shape), value.dtype)
    if isinstance(value, bool | int | float | np.number):
        return np.zeros(num_envs, type(value))
    return np.full(num_envs, None, dtype=object)
