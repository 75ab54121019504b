"""Vector environments in worker processes.

Additions to Gymnasium's `AsyncVectorEnv`: actions and seeds are validated before they reach a worker; an
exception keeps its type and names the sub-environment; an exception, a killed worker or Ctrl-C terminates all
workers at once; an exception in a `call`, such as an oracle without an action, terminates none.
"""

import atexit
import contextlib
import functools
import os
import queue
import sys
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any  # actions, observations and infos are nested dictionaries

import gymnasium
import numpy as np
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.async_vector_env import AsyncState

from openvima.env.action_validation import ActionValidator
from openvima.errors import WorkerError
from openvima.multiprocess import defer_sigint, exit_with_parent, init_worker, single_threaded_workers

_TIMEOUT_S = 5.0  # for an idle worker to exit, and for an exception to arrive


class AsyncTabletopEnvs(AsyncVectorEnv):
    """Sub-environments in worker processes. See `make_vec` and `SyncTabletopEnvs`.

    `call` and `get_attr` reach methods and attributes of all sub-environments and may raise without harm. An
    exception in `reset` or `step`, a killed worker, or Ctrl-C while waiting closes all sub-environments.

    Args:
        env_fns: Build the sub-environments.
        autoreset_mode: When the next episode begins.
    """

    def __init__(self, env_fns: Sequence[Callable[[], gymnasium.Env]], autoreset_mode: AutoresetMode) -> None:
        self._validator = ActionValidator(len(env_fns), autoreset_mode)
        self._starting = contextlib.ExitStack()
        try:
            with self._starting, single_threaded_workers():
                self._starting.enter_context(defer_sigint())
                # Spawned: a forked child of a process with threads can inherit locks that are never released.
                super().__init__(
                    [functools.partial(_build, env_fn, os.getpid()) for env_fn in env_fns],
                    context="spawn",
                    autoreset_mode=autoreset_mode,
                )
        except BaseException:
            self._end_workers(at_once=True)
            raise
        _OPEN.add(self)

    def reset_async(self, seed: Any = None, options: dict[str, Any] | None = None) -> None:
        """Send a reset to the workers; arguments as in `SyncTabletopEnvs.reset`."""
        seeds = self._validator.check_reset(seed, options)
        with self._close_on_error():
            super().reset_async(seeds, dict(options or {}))

    def reset_wait(self, timeout: float | None = None) -> tuple[Any, dict[str, Any]]:
        """Wait for the reset."""
        with self._close_on_error():
            result = super().reset_wait(timeout)
        self._validator.record_reset()
        return result

    def step_async(self, actions: Any) -> None:
        """Send a step to the workers; arguments as in `SyncTabletopEnvs.step`."""
        self._validator.check_step(actions)
        with self._close_on_error():
            super().step_async(actions)

    def step_wait(
        self, timeout: float | None = None
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Wait for the step."""
        with self._close_on_error():
            result = super().step_wait(timeout)
        self._validator.record_step(result[2] | result[3])
        return result

    def call_async(self, name: str, /, *args: object, **kwargs: object) -> None:
        """Request an attribute, or the result of a method, of every sub-environment."""
        with self._close_on_error():
            super().call_async(name, *args, **kwargs)

    def call_wait(self, timeout: float | None = None) -> tuple[Any, ...]:
        """Wait for the results."""
        with self._close_on_error():
            answers = super().call_wait(timeout)
        for index, answer in enumerate(answers):
            if isinstance(answer, _Failed):
                answer.error.add_note(f"raised in sub-environment {index}")
                raise answer.error
        return answers

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """Terminate the workers if asked or if they are busy, else let them exit.

        Gymnasium's own version waits for busy workers, and fails if one has died.
        """
        self._end_workers(at_once=terminate or self._state != AsyncState.DEFAULT, timeout_s=timeout)

    def _check_spaces(self) -> None:
        self._starting.close()  # all workers have been started; Ctrl-C may interrupt the wait
        with self._close_on_error():
            super()._check_spaces()

    def _raise_if_errors(self, successes: Iterable[bool]) -> None:
        """Raise the first exception of a worker, without the warning that Gymnasium logs first."""
        if all(successes):
            return
        try:
            index, _, error, trace = self.error_queue.get(timeout=_TIMEOUT_S)
        except queue.Empty:
            raise WorkerError(
                "a worker failed with an exception that cannot be pickled; see its output."
            ) from None
        error.add_note(f"raised in sub-environment {index}; all workers were ended.\n\n{trace}")
        raise error

    @contextlib.contextmanager
    def _close_on_error(self) -> Iterator[None]:
        """Terminate all workers if the block fails, except for calls in the wrong order."""
        try:
            yield
        except (AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError):
            raise
        except (EOFError, ConnectionError):
            message = self._describe_exit()
            self.close(terminate=True)
            raise WorkerError(message) from None
        except BaseException:
            self.close(terminate=True)
            raise

    def _describe_exit(self) -> str:
        for process in self.processes:
            process.join(timeout=0.2)  # its exit code may arrive after the end of its pipe
        codes = [(index, process.exitcode) for index, process in enumerate(self.processes)]
        dead = [f"{index} (exit code {code})" for index, code in codes if code is not None]
        return (
            f"the worker of sub-environment {', '.join(dead) or '?'} died; all others were terminated. "
            "Exit code -9 often means out of memory; 1 that it could not start: scripts need "
            '`if __name__ == "__main__":`, because workers import them.'
        )

    def _end_workers(self, *, at_once: bool, timeout_s: float | None = None) -> None:
        pipes = getattr(self, "parent_pipes", [])
        processes = [process for process in getattr(self, "processes", []) if process.pid is not None]
        if not at_once:
            for pipe in pipes:
                with contextlib.suppress(OSError):  # it may have died
                    pipe.send(("close", None))
            for process in processes:
                process.join(_TIMEOUT_S if timeout_s is None else timeout_s)
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()
        for pipe in pipes:
            pipe.close()


_OPEN: weakref.WeakSet[AsyncTabletopEnvs] = weakref.WeakSet()


@atexit.register
def _end_all_workers() -> None:
    """Close what a script left open before modules are torn down."""
    for envs in list(_OPEN):
        envs.close(terminate=True)


@dataclass(frozen=True, slots=True)
class _Failed:
    """An exception instead of a result."""

    error: Exception


class _ErrorCatcher(gymnasium.Wrapper):
    """Returns exceptions of calls instead of raising them, which would end the worker."""

    def close(self) -> None:
        # Gymnasium's worker closes its environment last. If its pipe broke, the parent has died: exit without
        # a traceback.
        if isinstance(sys.exc_info()[1], OSError):
            exit_with_parent()
        super().close()

    def get_wrapper_attr(self, name: str) -> Any:
        try:
            value = self.env.get_wrapper_attr(name)
        except Exception as error:
            return _Failed(error)
        return functools.partial(_attempt, value) if callable(value) else value


def _attempt(function: Any, *args: object, **kwargs: object) -> Any:
    try:
        return function(*args, **kwargs)
    except Exception as error:
        return _Failed(error)


def _build(env_fn: Callable[[], gymnasium.Env], parent_pid: int) -> gymnasium.Env:
    """Build a sub-environment in a worker; Gymnasium also builds one in the parent, for its spaces."""
    if os.getpid() != parent_pid:
        init_worker()
    return _ErrorCatcher(env_fn())
