"""Several environments of one process, and their infos in one.

Gymnasium's `SyncVectorEnv` gathers all observations after a step and copies them twice; here each is written
once, to its row of a batch, while it is in the CPU's cache.
"""

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any  # actions, observations and infos are nested dictionaries

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

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
