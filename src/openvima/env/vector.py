"""Vector environments, in this process or in worker processes.

Both have Gymnasium's interface, spaces and autoreset modes, and validate calls before anything moves. See
`workers` for the second kind.
"""

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from openvima.env.registration import make
from openvima.env.sub_environments import RESET_MASK, ActionValidator, SubEnvironments, batch_infos
from openvima.env.tabletop import TabletopEnv
from openvima.env.workers import AsyncTabletopEnvs
from openvima.errors import ConfigError, OpenVimaError, echo, unknown_name
from openvima.tasks.sampling import checked_seed


def make_vec(
    tasks: str | Sequence[str | Mapping[str, Any]],
    num_envs: int | None = None,
    *,
    num_workers: int = 0,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    seeds: Iterable[int] | None = None,
    **options: Any,  # of whatever type the constructor takes
) -> "SyncTabletopEnvs | AsyncTabletopEnvs":
    """Build a vector environment.

    Args:
        tasks: Name of the task; or a list of names, or of mappings with "task" and further options,
            assigned to the sub-environments in turn.
        num_envs: Number of sub-environments; by default one for each entry of `tasks`.
        num_workers: Number of worker processes, each with several sub-environments; 0: all are in this
            process. Workers need `if __name__ == "__main__":` in scripts, because they import them.
        autoreset_mode: "NextStep", "SameStep" or "Disabled", or Gymnasium's `AutoresetMode`: when the next
            episode starts.
        seeds: Seeds of the episodes: sub-environment i takes every `num_envs`-th, starting with the i-th, and
            repeats them. By default every `reset` without a seed draws one.
        **options: Further keyword arguments of `TabletopEnv` for all sub-environments.

    Returns:
        The vector environment; `reset` it first.

    Raises:
        UnknownTaskError: There is no such task.
        LevelError: A task is not defined at the level.
        ConfigError: A number, a mode, an option or a seed is invalid, or sub-environments differ in their
            spaces.
        WorkerError: A worker ended while it started.

    Example:
        >>> envs = make_vec("rotate", 4, level="L1")
        >>> observations, infos = envs.reset(seed=0)
        >>> observations["rgb"]["front"].shape
        (4, 3, 128, 256)
    """
    if not isinstance(tasks, Iterable):
        raise ConfigError(f"tasks is {echo(repr(tasks))}; give a name, or a list of names or mappings.")
    choices = [tasks] if isinstance(tasks, str) else list(tasks)
    num_envs = len(choices) if num_envs is None else num_envs
    if not choices or isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
        raise ConfigError(f"tasks are {choices}, num_envs is {num_envs!r}; give at least one of each.")
    if isinstance(num_workers, bool) or not isinstance(num_workers, int) or not 0 <= num_workers <= num_envs:
        raise ConfigError(
            f"num_workers is {num_workers!r}; with {num_envs} sub-environments give 0 to {num_envs}."
        )
    mode = _autoreset_mode(autoreset_mode)
    seed_lists = _split_seeds(seeds, num_envs)
    env_fns = [_env_factory(choices[i % len(choices)], options, seed_lists[i]) for i in range(num_envs)]
    control = _common_control(_build(env_fns[: len(choices)]))
    validator = ActionValidator(num_envs, mode, control)
    if num_workers == 0:
        return SyncTabletopEnvs(env_fns, validator, mode)
    return AsyncTabletopEnvs(env_fns, validator, mode, num_workers)


class SyncTabletopEnvs(SyncVectorEnv):
    """Sub-environments in this process. See `make_vec`.

    Args:
        env_fns: Build the sub-environments.
        validator: Checks resets and actions before anything moves.
        autoreset_mode: When the next episode starts.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gymnasium.Env]],
        validator: ActionValidator,
        autoreset_mode: AutoresetMode,
    ) -> None:
        super().__init__(env_fns, autoreset_mode=autoreset_mode)
        self._validator = validator
        self._played = SubEnvironments(self.envs, autoreset_mode, self._observations)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in all sub-environments, or in those of `options["reset_mask"]`.

        Args:
            seed: None, a number k (sub-environment i gets k + i), or a number or None for each.
            options: May hold "reset_mask", shape (num_envs,), bool.

        Returns:
            Batches of observations and infos.

        Raises:
            ConfigError: A seed or option is invalid.
            SamplingError: A task finds no start for its seed.
        """
        seeds = self._validator.check_reset(seed, options)
        self._validator.begin_reset()
        infos = self._played.reset(seeds, (options or {}).get(RESET_MASK))
        self._validator.record_reset()
        return copy.deepcopy(self._observations), batch_infos(infos)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take a step in every sub-environment.

        Args:
            actions: The four keys of an action, one row per sub-environment; with control "end_effector" an
                array, shape (num_envs, 5).

        Returns:
            Batches of observation, reward, terminated, truncated and info.

        Raises:
            EpisodeError: A sub-environment has no running episode.
            ActionError: An action is invalid. No sub-environment moved.
        """
        self._validator.check_step(actions)
        self._validator.begin_step()
        rewards, terminated, truncated, infos = self._played.step(actions)
        self._validator.record_step(self._played.is_over)
        return copy.deepcopy(self._observations), rewards, terminated, truncated, batch_infos(infos)


@dataclass(frozen=True, slots=True)
class EnvFactory:
    """Picklable constructor of one sub-environment.

    Args:
        options: Keyword arguments of `make`.
        seeds: Seeds of its episodes, or empty.
    """

    options: Mapping[str, Any]
    seeds: tuple[int, ...]

    def __call__(self) -> gymnasium.Env:
        """Build the sub-environment."""
        env = make(**self.options)
        return FixedSeeds(env, self.seeds) if self.seeds else env


class FixedSeeds(gymnasium.Wrapper):
    """Takes the seeds of its episodes from a list, cyclically.

    Args:
        env: The environment.
        seeds: Seeds of the episodes, at least one.
    """

    def __init__(self, env: gymnasium.Env, seeds: Sequence[int]) -> None:
        super().__init__(env)
        self._seeds = tuple(seeds)
        self._num_started = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Start the next episode of the list, or the requested one."""
        if seed is not None or options:
            return self.env.reset(seed=seed, options=options)
        seed = self._next_seed
        self._num_started += 1
        return self.env.reset(seed=seed)

    def prepare(self) -> None:
        """Build the next episode of the list ahead; see `TabletopEnv.prepare`."""
        cast(TabletopEnv, self.unwrapped).prepare(self._next_seed)

    @property
    def _next_seed(self) -> int:
        return self._seeds[self._num_started % len(self._seeds)]


def _env_factory(
    choice: str | Mapping[str, Any], options: Mapping[str, Any], seeds: tuple[int, ...]
) -> EnvFactory:
    own = {"task": choice} if isinstance(choice, str) else choice
    if not isinstance(own, Mapping) or "task" not in own:
        raise ConfigError(f"an entry of tasks is {own}; give a name, or a mapping with 'task' and options.")
    return EnvFactory({**options, **own}, seeds)


def _build(env_fns: Sequence[EnvFactory]) -> list[gymnasium.Env]:
    """Build sub-environments; an exception notes for which it was raised."""
    envs = []
    for index, env_fn in enumerate(env_fns):
        try:
            envs.append(env_fn())
        except OpenVimaError as error:
            error.add_note(f"raised for sub-environment {index}")
            raise
    return envs


def _common_control(envs: Sequence[gymnasium.Env]) -> str:
    """Check that sub-environments have equal spaces; return their control."""
    for index, env in enumerate(envs):
        for name in ("observation_space", "action_space"):
            if getattr(env, name) != getattr(envs[0], name):
                raise ConfigError(
                    f"sub-environments 0 and {index} differ in their {name}; give all the same control and "
                    "modalities."
                )
        env.close()
    return cast(TabletopEnv, envs[0].unwrapped).control


def _split_seeds(seeds: Iterable[int] | None, num_envs: int) -> list[tuple[int, ...]]:
    """Distribute the seeds over the sub-environments, round robin."""
    if seeds is None:
        return [()] * num_envs
    if not isinstance(seeds, Iterable):
        raise ConfigError(f"seeds is {echo(repr(seeds))}; give a list of integers, or None.")
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
