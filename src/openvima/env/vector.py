"""Several environments stepped together: in this process, or each in a process of its own.

Both kinds are Gymnasium's, with its spaces and autoreset modes. What is added to both: calls that cannot work
are refused before anything moves. See `workers` for what is added to processes.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any  # actions, observations and infos are nested dictionaries

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from openvima.env.action_validation import ActionValidator
from openvima.env.registration import make
from openvima.env.workers import AsyncTabletopEnvs
from openvima.errors import ConfigError, unknown_name
from openvima.tasks.seeding import checked_seed

MODES = ("sync", "async")


def make_vec(
    tasks: str | Sequence[str | Mapping[str, Any]],
    num_envs: int | None = None,
    *,
    vectorization_mode: str = "sync",
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    seeds: Iterable[int] | None = None,
    **options: Any,  # of whatever type the constructor takes
) -> "SyncTabletopEnvs | AsyncTabletopEnvs":
    """Build a vector environment.

    Args:
        tasks: Name of the task; or a list of names, or of mappings with "task" and further options, which
            the sub-environments take in turn.
        num_envs: Number of sub-environments; by default one for each entry of `tasks`.
        vectorization_mode: "sync": one after the other in this process. "async": each in a process of its
            own, with the observations in shared memory; a script must then keep what it does under
            `if __name__ == "__main__":`, for workers import it.
        autoreset_mode: "NextStep", "SameStep" or "Disabled", or Gymnasium's `AutoresetMode`: when an episode
            that ended is followed by the next.
        seeds: Numbers of the episodes to play: sub-environment i begins with the i-th one and goes on with
            each `num_envs`-th, then from its first again. By default every `reset` without a seed draws one.
        **options: Further keyword arguments of `TabletopEnv` for all sub-environments.

    Returns:
        The vector environment; `reset` it first.

    Raises:
        UnknownTaskError: There is no such task.
        LevelError: A task is not defined at the level.
        ConfigError: A mode, an option or a seed is not allowed.
        WorkerError: A worker ended while it started.

    Example:
        >>> envs = make_vec("rotate", 4, level="L1")
        >>> observations, infos = envs.reset(seed=0)
        >>> observations["rgb"]["front"].shape
        (4, 3, 128, 256)
    """
    choices = [tasks] if isinstance(tasks, str) else list(tasks)
    num_envs = len(choices) if num_envs is None else num_envs
    if not choices or isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
        raise ConfigError(f"got {len(choices)} tasks for {num_envs!r} sub-environments; give at least one.")
    if vectorization_mode not in MODES:
        raise ConfigError(unknown_name("vectorization mode", vectorization_mode, MODES))
    mode = _autoreset_mode(autoreset_mode)
    dealt = _deal(seeds, num_envs)
    recipes = [_recipe(choices[i % len(choices)], options, dealt[i]) for i in range(num_envs)]
    if vectorization_mode == "sync":
        return SyncTabletopEnvs(recipes, mode)
    for recipe in recipes:
        recipe().close()  # what cannot be built fails here, where its message is at home
    return AsyncTabletopEnvs(recipes, mode)


class SyncTabletopEnvs(SyncVectorEnv):
    """Sub-environments that take turns in this process. See `make_vec`.

    Args:
        recipes: Build the sub-environments.
        autoreset_mode: When the next episode begins.
    """

    def __init__(self, recipes: Sequence[Callable[[], gymnasium.Env]], autoreset_mode: AutoresetMode) -> None:
        super().__init__(recipes, autoreset_mode=autoreset_mode)
        self._gate = ActionValidator(len(recipes), autoreset_mode)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in all sub-environments, or in those of `options["reset_mask"]`.

        Args:
            seed: None, a number k (sub-environment i gets k + i), or a number or None for each.
            options: May hold "reset_mask", shape (num_envs,), bool.

        Returns:
            Batches of observations and infos.

        Raises:
            ConfigError: A seed or option is not allowed.
            SamplingError: A task finds no start for its seed.
        """
        seeds = self._gate.check_reset(seed, options)
        result = super().reset(seed=seeds, options=dict(options or {}))
        self._gate.note_reset()
        return result

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take a step in every sub-environment.

        Args:
            actions: The four keys of an action, each array with one row a sub-environment.

        Returns:
            Batches of observation, reward, terminated, truncated and info.

        Raises:
            EpisodeError: A sub-environment has no running episode.
            ActionError: An action does not fit. Nothing was moved in any sub-environment.
        """
        self._gate.check_step(actions)
        result = super().step(actions)
        self._gate.note_step(result[2] | result[3])
        return result


@dataclass(frozen=True, slots=True)
class Recipe:
    """How to build one sub-environment; workers receive it.

    Args:
        options: Keyword arguments of `make`.
        seeds: Numbers of its episodes, or empty.
    """

    options: Mapping[str, Any]
    seeds: tuple[int, ...]

    def __call__(self) -> gymnasium.Env:
        """Build it."""
        env = make(**self.options)
        return FixedSeeds(env, self.seeds) if self.seeds else env


class FixedSeeds(gymnasium.Wrapper):
    """Takes the seeds of its episodes from a list, in order, and from the first again after the last.

    Args:
        env: The environment.
        seeds: Numbers of the episodes, at least one.
    """

    def __init__(self, env: gymnasium.Env, seeds: Sequence[int]) -> None:
        super().__init__(env)
        self._seeds = tuple(seeds)
        self._num_started = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Start the next episode of the list, or the one that is asked for."""
        if seed is not None or options:
            return self.env.reset(seed=seed, options=options)
        seed = self._seeds[self._num_started % len(self._seeds)]
        self._num_started += 1
        return self.env.reset(seed=seed)


def _recipe(choice: str | Mapping[str, Any], options: Mapping[str, Any], seeds: tuple[int, ...]) -> Recipe:
    own = {"task": choice} if isinstance(choice, str) else dict(choice)
    if "task" not in own:
        raise ConfigError(f"an entry of tasks is {own}; give a name, or a mapping with 'task' and options.")
    return Recipe({**options, **own}, seeds)


def _deal(seeds: Iterable[int] | None, num_envs: int) -> list[tuple[int, ...]]:
    """Give each sub-environment its seeds, like cards."""
    if seeds is None:
        return [()] * num_envs
    numbers = tuple(checked_seed(seed) for seed in seeds)
    if len(numbers) < num_envs:
        raise ConfigError(
            f"got {len(numbers)} seeds for {num_envs} sub-environments; give at least one each."
        )
    return [numbers[index::num_envs] for index in range(num_envs)]


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        names = [known.value for known in AutoresetMode]
        raise ConfigError(unknown_name("autoreset mode", mode, names)) from None
