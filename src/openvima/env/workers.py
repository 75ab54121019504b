"""Vector environments in worker processes, each with several sub-environments.

A call is one message to each worker and one back; observations are in shared memory. Actions and seeds are
validated before they reach a worker; an exception keeps its type and names the sub-environment; an exception,
a killed worker or Ctrl-C terminates all workers at once; an exception in a `call`, such as an oracle without
an action, terminates none.
"""

import atexit
import contextlib
import copy
import itertools
import multiprocessing
import pickle
import time
import traceback
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any  # actions, observations and infos are nested dictionaries

import gymnasium
import numpy as np
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, create_shared_memory, read_from_shared_memory

from openvima.env.sub_environments import (
    RESET_MASK,
    ActionValidator,
    Info,
    SubEnvironments,
    batch_infos,
    rows,
)
from openvima.errors import WorkerError
from openvima.multiprocess import defer_sigint, exit_with_parent, init_worker, single_threaded_workers

_EXIT_S = 5.0  # for an idle worker to exit
_CLOSE = "close"


class AsyncTabletopEnvs(VectorEnv):
    """Sub-environments in worker processes. See `make_vec` and `SyncTabletopEnvs`.

    `call`, `get_attr` and `set_attr` reach all sub-environments and may raise without harm. An exception in
    `reset` or `step`, a killed worker, or Ctrl-C while waiting closes all sub-environments. The halves of
    `reset`, `step` and `call`, such as `step_async` and `step_wait`, leave time for other work between them.

    Args:
        env_fns: Build the sub-environments, which have equal spaces.
        validator: Checks resets and actions before they are sent.
        autoreset_mode: When the next episode begins.
        num_workers: Number of processes; consecutive sub-environments share one.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gymnasium.Env]],
        validator: ActionValidator,
        autoreset_mode: AutoresetMode,
        num_workers: int,
    ) -> None:
        self.num_envs, self._validator = len(env_fns), validator
        self._pending: str | None = None  # what was sent and not yet answered
        self._have_started = False
        self._pipes: list[Connection] = []
        self.processes: list[BaseProcess] = []
        first = env_fns[0]()
        self.metadata = {**first.metadata, "autoreset_mode": autoreset_mode}
        self.render_mode = first.render_mode
        self.single_observation_space, self.single_action_space = first.observation_space, first.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        first.close()
        bounds = np.linspace(0, self.num_envs, num_workers + 1).round().astype(int).tolist()
        self._parts = [slice(*part) for part in itertools.pairwise(bounds)]
        # Spawned: a forked child of a process with threads can inherit locks that are never released.
        context = multiprocessing.get_context("spawn")
        memory = create_shared_memory(self.single_observation_space, self.num_envs, context)
        self._observations = read_from_shared_memory(self.single_observation_space, memory, self.num_envs)
        try:
            with single_threaded_workers(), defer_sigint():
                for part in self._parts:
                    here, there = context.Pipe()
                    self._pipes.append(here)
                    arguments = (there, env_fns[part], part, autoreset_mode, memory, self.num_envs)
                    self.processes.append(context.Process(target=_work, args=arguments, daemon=True))
                    self.processes[-1].start()
                    there.close()
            with self._close_on_error():
                self._receive(None)  # that they have started
            self._have_started = True
        except BaseException:
            self.close(terminate=True)
            raise
        _OPEN.add(self)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start episodes, as `SyncTabletopEnvs.reset` does."""
        self.reset_async(seed, options)
        return self.reset_wait()

    def reset_async(self, seed: Any = None, options: dict[str, Any] | None = None) -> None:
        """Send a reset to the workers; arguments as in `SyncTabletopEnvs.reset`."""
        seeds = self._validator.check_reset(seed, options)
        mask = (options or {}).get(RESET_MASK)
        self._send("reset", [(seeds[part], None if mask is None else mask[part]) for part in self._parts])

    def reset_wait(self, timeout: float | None = None) -> tuple[Any, dict[str, Any]]:
        """Wait for the reset, for `timeout` seconds at most."""
        infos = self._wait("reset", timeout)
        self._validator.record_reset()
        return copy.deepcopy(self._observations), _join_infos(infos)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take a step in every sub-environment, as `SyncTabletopEnvs.step` does."""
        self.step_async(actions)
        return self.step_wait()

    def step_async(self, actions: Any) -> None:
        """Send a step to the workers; arguments as in `SyncTabletopEnvs.step`."""
        self._validator.check_step(actions)
        self._send("step", [(rows(actions, part),) for part in self._parts])

    def step_wait(
        self, timeout: float | None = None
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Wait for the step, for `timeout` seconds at most."""
        answers = self._wait("step", timeout)
        *ends, infos = zip(*answers, strict=True)
        rewards, terminated, truncated = (np.concatenate(values) for values in ends)
        self._validator.record_step(terminated | truncated)
        observations = copy.deepcopy(self._observations)
        return observations, rewards, terminated, truncated, _join_infos(infos)

    def call(self, name: str, /, *args: object, **kwargs: object) -> tuple[Any, ...]:
        """Return an attribute, or the result of a method, of every sub-environment."""
        self.call_async(name, *args, **kwargs)
        return self.call_wait()

    def call_async(self, name: str, /, *args: object, **kwargs: object) -> None:
        """Request what `call` returns."""
        self._send("call", [(name, args, kwargs)] * len(self._parts))

    def call_wait(self, timeout: float | None = None) -> tuple[Any, ...]:
        """Wait for the results, for `timeout` seconds at most."""
        return self._results("call", timeout)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of every sub-environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of every sub-environment; a list or tuple has a value for each."""
        values = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ValueError(f"got {len(values)} values for {self.num_envs} sub-environments; give one each.")
        self._send("set_attr", [(name, values[part]) for part in self._parts])
        self._results("set_attr", None)

    def render(self) -> tuple[Any, ...]:
        """Return the picture of every sub-environment."""
        return self.call("render")

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """End the workers: let them exit, or terminate them if asked or if they are busy."""
        if not terminate and self._pending is None:
            for pipe in self._pipes:
                with contextlib.suppress(OSError):  # it may have died
                    pipe.send((_CLOSE, ()))
            for process in self.processes:
                process.join(_EXIT_S if timeout is None else timeout)
        for process in self.processes:
            process.terminate()
        for process in self.processes:
            process.join()
        for pipe in self._pipes:
            pipe.close()

    def __del__(self) -> None:
        if not getattr(self, "closed", True):
            self.close(terminate=True)

    def _send(self, name: str, arguments: Sequence[tuple[Any, ...]]) -> None:
        if self.closed:
            raise ClosedEnvironmentError("the environments are closed; make new ones.")
        if self._pending:
            raise AlreadyPendingCallError(f"call `{self._pending}_wait` before `{name}`.", self._pending)
        # Before anything is sent: what cannot be pickled is the caller's and harms no worker.
        messages = [ForkingPickler.dumps((name, given)) for given in arguments]
        with self._close_on_error():
            for pipe, message in zip(self._pipes, messages, strict=True):
                pipe.send_bytes(message)
        self._pending = name

    def _wait(self, name: str, timeout_s: float | None) -> list[Any]:
        if self.closed:
            raise ClosedEnvironmentError("the environments are closed; make new ones.")
        if self._pending != name:
            raise NoAsyncCallError(f"call `{name}_async` before `{name}_wait`.", name)
        with self._close_on_error():
            answers = self._receive(timeout_s)
        self._pending = None
        return answers

    def _results(self, name: str, timeout_s: float | None) -> tuple[Any, ...]:
        """Return the result of every sub-environment; raise the first exception among them."""
        results = [result for answer in self._wait(name, timeout_s) for result in answer]
        for result in results:
            if isinstance(result, _Failure):
                raise result.error
        return tuple(results)

    def _receive(self, timeout_s: float | None) -> list[Any]:
        """Return the answers of all workers; raise the first exception among them."""
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        answers = []
        for pipe in self._pipes:
            if deadline_s is not None and not pipe.poll(max(0.0, deadline_s - time.monotonic())):
                raise multiprocessing.TimeoutError(f"no answer of the workers in {timeout_s} s.")
            answers.append(pipe.recv())
        for answer in answers:
            if isinstance(answer, _Failure):
                raise answer.error
        return answers

    @contextlib.contextmanager
    def _close_on_error(self) -> Iterator[None]:
        """Terminate all workers if the block fails."""
        try:
            yield
        except (EOFError, ConnectionError):
            message = self._describe_exit()
            self.close(terminate=True)
            raise WorkerError(message) from None
        except BaseException:
            self.close(terminate=True)
            raise

    def _describe_exit(self) -> str:
        dead = []
        for part, process in zip(self._parts, self.processes, strict=False):
            process.join(timeout=0.2)  # its exit code may arrive after the end of its pipe
            if process.exitcode is not None:
                to = f" to {part.stop - 1}" if part.stop - part.start > 1 else ""
                dead.append(f"{part.start}{to} (exit code {process.exitcode})")
        which = f"the worker of sub-environment {', '.join(dead) or '?'}"
        if not self._have_started:
            return (
                f'{which} could not start: scripts need `if __name__ == "__main__":`, as workers import them.'
            )
        return f"{which} died; all others were terminated. Exit code -9 often means out of memory."


_OPEN: weakref.WeakSet[AsyncTabletopEnvs] = weakref.WeakSet()


@atexit.register
def _end_all_workers() -> None:
    """Close what a script left open before modules are torn down."""
    for envs in list(_OPEN):
        envs.close(terminate=True)


def _join_infos(infos: Iterable[Sequence[Info | None]]) -> dict[str, Any]:
    """Join the infos of all workers."""
    return batch_infos(list(itertools.chain.from_iterable(infos)))


@dataclass(frozen=True, slots=True)
class _Failure:
    """An exception instead of a result."""

    error: Exception


class _Numbered(gymnasium.Wrapper):
    """Notes in exceptions which sub-environment raised them, with the traceback.

    Args:
        env: The sub-environment.
        index: Its number.
    """

    def __init__(self, env: gymnasium.Env, index: int) -> None:
        super().__init__(env)
        self._index = index

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        with self._noted():
            return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        with self._noted():
            return self.env.step(action)

    def attempt(self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Return an attribute, the result of a method, or what it raised."""
        try:
            value = self.env.get_wrapper_attr(name)
            return value(*args, **kwargs) if callable(value) else value
        except Exception as error:
            error.add_note(f"raised in sub-environment {self._index}")
            return _Failure(error)

    @contextlib.contextmanager
    def _noted(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            where = f"raised in sub-environment {self._index}; all workers were ended."
            error.add_note(f"{where}\n\n{traceback.format_exc()}")
            raise


class _Worker:
    """The sub-environments of one process.

    Args:
        env_fns: Build them.
        part: Their numbers.
        autoreset_mode: When the next episode begins.
        memory: Shared memory for the observations of all sub-environments.
        num_envs: Number of all.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gymnasium.Env]],
        part: slice,
        autoreset_mode: AutoresetMode,
        memory: Any,
        num_envs: int,
    ) -> None:
        self._numbered = [_Numbered(env_fn(), index) for index, env_fn in enumerate(env_fns, part.start)]
        shared = read_from_shared_memory(self._numbered[0].observation_space, memory, num_envs)
        self._played = SubEnvironments(self._numbered, autoreset_mode, rows(shared, part))

    def reset(self, seeds: list[int | None], mask: np.ndarray | None) -> list[Info | None]:
        """Start episodes where the mask is true; return the infos."""
        return self._played.reset(seeds, mask)

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Info | None]]:
        """Take a step; return rewards, terminated, truncated and infos."""
        return self._played.step(actions)

    def prepare(self) -> bool:
        """Build one episode ahead; return whether there was one to build."""
        return self._played.prepare()

    def call(self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> list[Any]:
        """Return results, or what was raised instead."""
        return [env.attempt(name, args, kwargs) for env in self._numbered]

    def set_attr(self, name: str, values: Sequence[Any]) -> list[Any]:
        """Set an attribute; return what was raised, if anything."""
        pairs = zip(self._numbered, values, strict=True)
        return [env.attempt("set_wrapper_attr", (name, value), {}) for env, value in pairs]

    def close(self) -> None:
        """Close them."""
        for env in self._numbered:
            env.close()


def _work(pipe: Connection, *arguments: Any) -> None:
    """Build the sub-environments, and answer messages until one says to close."""
    init_worker()
    try:
        worker = _Worker(*arguments)
        pipe.send(None)
        while (message := _receive_or_prepare(pipe, worker))[0] != _CLOSE:
            name, given = message
            try:
                pipe.send(getattr(worker, name)(*given))
            except (EOFError, ConnectionError):
                raise
            except Exception as error:
                _send_failure(pipe, error)
        worker.close()
    except (EOFError, ConnectionError):  # the parent has died: exit without a traceback
        exit_with_parent()


def _receive_or_prepare(pipe: Connection, worker: _Worker) -> Any:
    """Wait for a message, and build episodes ahead until one is there."""
    while not pipe.poll() and worker.prepare():
        pass
    return pipe.recv()


def _send_failure(pipe: Connection, error: Exception) -> None:
    try:
        pickle.loads(pickle.dumps(error))
        pipe.send(_Failure(error))
    except Exception:
        traceback.print_exception(error)
        message = "a worker failed with an exception that cannot be pickled; see its output."
        pipe.send(_Failure(WorkerError(message)))
