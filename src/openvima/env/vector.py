"""Vector environments: several sub-environments in this process, or in worker processes.

The interface, spaces and autoreset modes are Gymnasium's. Seeds and actions are checked before anything
moves, which Gymnasium's own classes do not. Every process steps several sub-environments in turn, and an
observation is written once, to its row of a batch, which workers share. A worker that waits builds the next
episodes.
"""

import contextlib
import copy
import functools
import itertools
import multiprocessing
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any, cast  # actions, observations and infos are nested dictionaries

import gymnasium
import numpy as np
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, create_shared_memory, read_from_shared_memory

from openvima.env.registration import make
from openvima.env.tabletop import TabletopEnv, reset_option
from openvima.errors import ActionError, ConfigError, EpisodeError, WorkerError, unknown_name
from openvima.multiprocess import defer_sigint, init_worker, single_threaded_workers
from openvima.scene import ACTION_SHAPES, WORKSPACE_LOW, Action
from openvima.scene.action import COMMAND_NAMES, END_EFFECTOR, ToolCommand
from openvima.tasks.sampling import checked_seed

RESET_MASK = "reset_mask"  # Gymnasium's option: which sub-environments to reset, shape (N,), bool

Info = Mapping[str, Any]
EnvFns = Sequence[Callable[[], gymnasium.Env]]


def make_vec(
    tasks: str | Sequence[str | Mapping[str, Any]],
    num_envs: int | None = None,
    *,
    num_workers: int = 0,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    seeds: Iterable[int] | None = None,
    **options: Any,
) -> "TabletopVectorEnv":
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
        ConfigError: A task is not defined at the level.
        ConfigError: A number, a mode, an option or a seed is invalid, or sub-environments differ in their
            spaces.
        WorkerError: A worker ended while it started.

    Example:
        >>> envs = make_vec("rotate", 4, level="L1")
        >>> observations, infos = envs.reset(seed=0)
        >>> observations["rgb"]["front"].shape
        (4, 3, 128, 256)
    """
    choices = [tasks] if isinstance(tasks, str) else list(tasks)
    num_envs = len(choices) if num_envs is None else num_envs
    if not choices or num_envs < 1:
        raise ConfigError(f"tasks are {choices}, num_envs is {num_envs!r}; give at least one of each.")
    if num_workers not in range(num_envs + 1):
        raise ConfigError(
            f"num_workers is {num_workers!r}; with {num_envs} sub-environments give 0 to {num_envs}."
        )
    try:
        mode = AutoresetMode(autoreset_mode)
    except ValueError:
        modes = [known.value for known in AutoresetMode]
        raise ConfigError(unknown_name("autoreset mode", autoreset_mode, modes)) from None
    numbers = [] if seeds is None else [checked_seed(seed) for seed in seeds]
    if seeds is not None and len(numbers) < num_envs:
        raise ConfigError(
            f"got {len(numbers)} seeds for {num_envs} sub-environments; give at least one each."
        )
    env_fns = [
        _constructor(choice, options) for choice in itertools.islice(itertools.cycle(choices), num_envs)
    ]
    split_seeds = [numbers[index::num_envs] for index in range(num_envs)]
    return TabletopVectorEnv(env_fns, split_seeds, mode, num_workers)


def _constructor(choice: str | Mapping[str, Any], options: Mapping[str, Any]) -> Callable[[], TabletopEnv]:
    own = {"task": choice} if isinstance(choice, str) else choice
    if not isinstance(own, Mapping) or "task" not in own:
        raise ConfigError(f"an entry of tasks is {own}; give a name, or a mapping with 'task' and options.")
    return functools.partial(make, **{**options, **own})


class TabletopVectorEnv(VectorEnv):
    """Sub-environments of one process or several. See `make_vec`.

    `call`, `get_attr` and `set_attr` reach all sub-environments and may raise without harm. Where there are
    workers, an exception in `reset` or `step`, a killed worker, or Ctrl-C while waiting ends all of them.

    Args:
        env_fns: Build the sub-environments, which have equal spaces.
        seeds: Of each sub-environment: seeds of its episodes, or none.
        autoreset_mode: When the next episode begins.
        num_workers: Number of processes; consecutive sub-environments share one. 0: all are in this one.
    """

    def __init__(
        self,
        env_fns: EnvFns,
        seeds: Sequence[Sequence[int]],
        autoreset_mode: AutoresetMode,
        num_workers: int,
    ) -> None:
        self.processes: list[BaseProcess] = []
        self._pipes: list[Connection] = []
        envs = _build(env_fns)
        self.num_envs, self._mode = len(envs), autoreset_mode
        self.metadata = {**envs[0].metadata, "autoreset_mode": autoreset_mode}
        self.render_mode = envs[0].render_mode
        self.control = cast(TabletopEnv, envs[0].unwrapped).control
        self.single_observation_space, self.single_action_space = (
            envs[0].observation_space,
            envs[0].action_space,
        )
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._needs_reset = np.ones(self.num_envs, dtype=bool)
        bounds = np.linspace(0, self.num_envs, max(num_workers, 1) + 1).round().astype(int).tolist()
        self._slices = [slice(*each) for each in itertools.pairwise(bounds)]
        # Spawned: a forked child of a process with threads can inherit locks that are never released.
        context = multiprocessing.get_context("spawn")
        memory = create_shared_memory(self.single_observation_space, self.num_envs, context)
        self._observations = read_from_shared_memory(self.single_observation_space, memory, self.num_envs)
        if num_workers == 0:
            self._part = _Part(envs, seeds, autoreset_mode, self._observations)
            return
        with single_threaded_workers(), defer_sigint():
            for part in self._slices:
                here, there = context.Pipe()
                self._pipes.append(here)
                arguments = (there, env_fns[part], seeds[part], autoreset_mode, part, memory, self.num_envs)
                self.processes.append(context.Process(target=_work, args=arguments, daemon=True))
                self.processes[-1].start()
                there.close()
        self._ask("call", [("render_mode", (), {})] * num_workers)  # once all have started

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
        seeds = _checked_seeds(seed, self.num_envs)
        mask = _checked_mask(reset_option(options, RESET_MASK), self.num_envs)
        self._needs_reset |= mask  # should it fail
        infos = self._ask("reset", [(seeds[part], mask[part]) for part in self._slices])
        self._needs_reset &= ~mask
        return copy.deepcopy(self._observations), self._join(infos)

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
        if self._needs_reset.any() and not self.closed:
            waiting = ", ".join(map(str, np.flatnonzero(self._needs_reset)))
            how = "reset()" if self._needs_reset.all() else f"reset(options={{'{RESET_MASK}': mask}})"
            raise EpisodeError(f"sub-environments {waiting} have no running episode; call {how} first.")
        _check_actions(actions, self.num_envs, self.control)
        self._needs_reset[:] = True  # should it fail, some are a step ahead
        answers = self._ask("step", [(_rows(actions, part),) for part in self._slices])
        *ends, infos = zip(*answers, strict=True)
        rewards, terminated, truncated = (np.concatenate(values) for values in ends)
        self._needs_reset = (terminated | truncated) & (self._mode is AutoresetMode.DISABLED)
        return copy.deepcopy(self._observations), rewards, terminated, truncated, self._join(infos)

    def call(self, name: str, /, *args: object, **kwargs: object) -> tuple[Any, ...]:
        """Return an attribute, or the result of a method, of every sub-environment."""
        answers = self._ask("call", [(name, args, kwargs)] * len(self._slices))
        return tuple(itertools.chain.from_iterable(answers))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of every sub-environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every sub-environment; a list or tuple has a value for each."""
        values = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        self._ask("set_attr", [(name, values[part]) for part in self._slices])

    def render(self) -> tuple[Any, ...]:
        """Return the picture of every sub-environment."""
        return self.call("render")

    def close_extras(self) -> None:
        """End the workers."""
        for process in self.processes:
            process.terminate()
        for process, pipe in zip(self.processes, self._pipes, strict=True):
            process.join()
            pipe.close()

    def __del__(self) -> None:
        if not self.closed:
            self.close()

    def _ask(self, name: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Call a method of every `_Part`; return the answers, or raise the first exception among them."""
        if self.closed:
            raise ClosedEnvironmentError("the environments are closed; make new ones.")
        if not self.processes:
            return [getattr(self._part, name)(*arguments[0])]
        # Before anything is sent: what cannot be pickled is the caller's and harms no worker.
        messages = [ForkingPickler.dumps((name, given)) for given in arguments]
        try:
            for pipe, message in zip(self._pipes, messages, strict=True):
                pipe.send_bytes(message)
            answers = [pipe.recv() for pipe in self._pipes]
        except (EOFError, ConnectionError):
            message = self._describe_exit()
            self.close()
            raise WorkerError(message) from None
        except BaseException:  # Ctrl-C
            self.close()
            raise
        for answer in answers:
            if isinstance(answer, Exception):
                if name in ("reset", "step"):
                    self.close()
                raise answer
        return answers

    def _describe_exit(self) -> str:
        dead = []
        for part, process in zip(self._slices, self.processes, strict=True):
            process.join(timeout=0.2)  # its exit code may arrive after the end of its pipe
            if process.exitcode is not None:
                dead += [f"{index} (exit code {process.exitcode})" for index in range(part.start, part.stop)]
        return (
            f"the worker of sub-environment {', '.join(dead) or '?'} died; all others were terminated. Exit "
            "code -9 often means out of memory; code 1 at the start, that a script lacks `if __name__ == "
            '"__main__":`.'
        )

    def _join(self, infos: Iterable[Sequence[Info | None]]) -> dict[str, Any]:
        batch: dict[str, Any] = {}
        for index, info in enumerate(itertools.chain.from_iterable(infos)):
            batch = self._add_info(batch, dict(info or {}), index)
        return batch


class _Part:
    """Sub-environments that one process steps in turn.

    Args:
        envs: The environments.
        seeds: Of each: seeds of its episodes, or none.
        autoreset_mode: When the next episode begins.
        observations: Batch that observations are written to, one row for each environment.
        first: Number of the first one.
    """

    def __init__(
        self,
        envs: Sequence[gymnasium.Env],
        seeds: Sequence[Sequence[int]],
        autoreset_mode: AutoresetMode,
        observations: Any,
        first: int = 0,
    ) -> None:
        self._envs, self._mode, self._observations, self._first = envs, autoreset_mode, observations, first
        self._seeds = [itertools.cycle(numbers or [None]) for numbers in seeds]
        self._next_seeds = [next(numbers) for numbers in self._seeds]
        self._is_over = np.zeros(len(envs), dtype=bool)
        self._was_seeded = np.ones(len(envs), dtype=bool)  # the last reset; the next one may be as well
        self._is_prepared = np.zeros(len(envs), dtype=bool)

    def reset(self, seeds: Sequence[int | None], mask: np.ndarray) -> list[Info | None]:
        """Start episodes where the mask is true; return their infos."""
        pairs = enumerate(zip(seeds, mask, strict=True))
        return [self._reset(index, seed) if is_asked else None for index, (seed, is_asked) in pairs]

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Info]]:
        """Take a step, or start an episode where the last one is over and the mode says so.

        Returns:
            Rewards, shape (N,), float64; terminated and truncated, shape (N,), bool; infos.
        """
        rewards = np.zeros(len(self._envs))
        terminated, truncated = np.zeros((2, len(self._envs)), dtype=bool)
        infos: list[Info] = []
        for index, env in enumerate(self._envs):
            if self._mode is AutoresetMode.NEXT_STEP and self._is_over[index]:
                infos.append(self._reset(index, None))
                continue
            with self._noted(index):
                result = env.step(_rows(actions, index))
            observation, rewards[index], terminated[index], truncated[index], info = result
            if self._mode is AutoresetMode.SAME_STEP and (terminated[index] or truncated[index]):
                info = {"final_obs": observation, "final_info": info, **self._reset(index, None)}
            else:
                _write(observation, self._observations, index)
            infos.append(info)
        self._is_over = terminated | truncated
        return rewards, terminated, truncated, infos

    def call(self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> list[Any]:
        """Return an attribute, or the result of a method, of every one."""
        results = []
        for index, env in enumerate(self._envs):
            with self._noted(index):
                value = env.get_wrapper_attr(name)
                results.append(value(*args, **kwargs) if callable(value) else value)
        return results

    def set_attr(self, name: str, values: Sequence[Any]) -> None:
        """Set an attribute of every one."""
        for env, value in zip(self._envs, values, strict=True):
            env.set_wrapper_attr(name, value)

    def prepare(self) -> bool:
        """Build one episode ahead of a reset without a seed that is certain or likely to come.

        Returns:
            Whether there was one to build.
        """
        is_certain = self._is_over & (self._mode is AutoresetMode.NEXT_STEP)
        is_wanted = (is_certain | ~self._was_seeded) & ~self._is_prepared
        if not is_wanted.any():
            return False
        index = int(np.argmax(is_wanted * (1 + is_certain)))
        self._is_prepared[index] = True
        with contextlib.suppress(Exception):  # the reset will raise it
            self._envs[index].get_wrapper_attr("prepare")(self._next_seeds[index])
        return True

    def _reset(self, index: int, seed: int | None) -> Info:
        self._was_seeded[index], self._is_prepared[index] = seed is not None, False
        if seed is None:
            seed, self._next_seeds[index] = self._next_seeds[index], next(self._seeds[index])
        with self._noted(index):
            observation, info = self._envs[index].reset(seed=seed)
        _write(observation, self._observations, index)
        self._is_over[index] = False
        return info

    @contextlib.contextmanager
    def _noted(self, index: int) -> Any:
        """Note in exceptions which sub-environment raised them."""
        try:
            yield
        except Exception as error:
            error.add_note(f"raised in sub-environment {self._first + index}")
            raise


def _work(
    pipe: Connection,
    env_fns: EnvFns,
    seeds: Sequence[Sequence[int]],
    autoreset_mode: AutoresetMode,
    part: slice,
    memory: Any,
    num_envs: int,
) -> None:
    """Build sub-environments in a worker, and answer calls until the parent ends it."""
    init_worker()
    envs = [env_fn() for env_fn in env_fns]
    shared = read_from_shared_memory(envs[0].observation_space, memory, num_envs)
    worker = _Part(envs, seeds, autoreset_mode, _rows(shared, part), part.start)
    with contextlib.suppress(EOFError, ConnectionError):  # the parent has died
        while True:
            while not pipe.poll() and worker.prepare():
                pass
            name, arguments = pipe.recv()
            try:
                answer = getattr(worker, name)(*arguments)
            except Exception as error:
                error.add_note(traceback.format_exc())
                answer = error
            try:
                pipe.send(answer)
            except (AttributeError, TypeError, ValueError):  # raised before anything is sent
                pipe.send(WorkerError(f"an answer of a worker cannot be pickled: {answer!r}"))


def _build(env_fns: EnvFns) -> list[gymnasium.Env]:
    """Build sub-environments and check that their spaces are equal."""
    envs: list[gymnasium.Env] = []
    for index, env_fn in enumerate(env_fns):
        try:
            envs.append(env_fn())
        except Exception as error:
            error.add_note(f"raised for sub-environment {index}")
            raise
        for name in ("observation_space", "action_space"):
            if getattr(envs[index], name) != getattr(envs[0], name):
                raise ConfigError(
                    f"sub-environments 0 and {index} differ in their {name}; give all the same control and "
                    "modalities."
                )
    return envs


def _checked_seeds(seed: Any, num_envs: int) -> list[int | None]:
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, Sequence | np.ndarray):
        seeds: list[int | None] = [None if entry is None else checked_seed(entry) for entry in seed]
    else:
        seeds = [checked_seed(checked_seed(seed) + index) for index in range(num_envs)]
    if len(seeds) != num_envs:
        raise ConfigError(f"got {len(seeds)} seeds for {num_envs} sub-environments; give one each.")
    return seeds


def _checked_mask(mask: Any, num_envs: int) -> np.ndarray:
    if mask is None:
        return np.ones(num_envs, dtype=bool)
    if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (num_envs,) or not mask.any():
        raise ConfigError(
            f"option '{RESET_MASK}' is {mask!r}; give an array of shape ({num_envs},), dtype bool, with at "
            "least one True."
        )
    return mask


def _check_actions(actions: Any, num_envs: int, control: str) -> None:
    """Check a batch of actions.

    Raises:
        ActionError: It has another form, or an action is invalid; the first one is named.
    """
    check: Callable[[Any], object] = Action.from_arrays
    wanted: Any = {key: (num_envs, length) for key, length in ACTION_SHAPES.items()}
    if control == END_EFFECTOR:
        check, wanted = ToolCommand.from_array, (num_envs, len(COMMAND_NAMES))
    given = getattr(actions, "shape", type(actions).__name__)
    if isinstance(actions, Mapping):
        given = {key: np.shape(value) for key, value in actions.items()}
    if given != wanted:
        raise ActionError(
            f"actions have the form {given}; give arrays of shapes {wanted}, a row for each sub-environment. "
            "`stack_actions` makes those of primitives from a list. Nothing was moved."
        )
    for index in range(num_envs):
        try:
            check(_rows(actions, index))
        except ActionError as error:
            raise ActionError(f"sub-environment {index}: {error}") from None


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
    rows = []
    for index, action in enumerate(corner if action is None else action for action in actions):
        try:
            rows.append((action if isinstance(action, Action) else Action.from_arrays(action)).to_arrays())
        except ActionError as error:
            raise ActionError(f"action {index}: {error}") from None
    return {key: np.stack([row[key] for row in rows]) for key in ACTION_SHAPES}


def _rows(batch: Any, which: int | slice) -> Any:
    """Return one row, or consecutive ones, of an array or of nested mappings of arrays."""
    if isinstance(batch, Mapping):
        return {key: _rows(values, which) for key, values in batch.items()}
    return batch[which]


def _write(observation: Any, batch: Any, index: int) -> None:
    """Write an observation to its row."""
    if isinstance(observation, Mapping):
        for key, value in observation.items():
            _write(value, batch[key], index)
    else:
        batch[index] = observation
