"""Environments in processes of their own.

Gymnasium's `AsyncVectorEnv` brings the workers, the autoreset modes and the shared memory of the images. What
it lacks is added here: a bad action or seed is refused before it ends a worker; an error keeps its type and
says where it happened; an error, a killed worker or Ctrl-C ends all workers, quietly and at once; an error in
a call, such as an oracle without an action, ends none.
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

_PATIENCE_S = 5.0  # for an idle worker to end by itself, and for an error to arrive


class AsyncTabletopEnvs(AsyncVectorEnv):
    """Sub-environments in processes of their own. See `make_vec`; the calls are those of the other kind.

    Methods and attributes of all sub-environments are reached by `call` and `get_attr`; an error there does
    no harm. An error in `reset` or `step`, a killed worker, or Ctrl-C while waiting closes everything.

    Args:
        recipes: Build the sub-environments.
        autoreset_mode: When the next episode begins.
    """

    def __init__(self, recipes: Sequence[Callable[[], gymnasium.Env]], autoreset_mode: AutoresetMode) -> None:
        self._gate = ActionValidator(len(recipes), autoreset_mode)
        self._starting = contextlib.ExitStack()
        try:
            with self._starting, single_threaded_workers():
                self._starting.enter_context(defer_sigint())
                # Spawned, not forked: a child of a process with threads can inherit locks that nobody opens.
                super().__init__(
                    [functools.partial(_build, recipe, os.getpid()) for recipe in recipes],
                    context="spawn",
                    autoreset_mode=autoreset_mode,
                )
        except BaseException:
            self._end_workers(at_once=True)
            raise
        _OPEN.add(self)

    def reset_async(self, seed: Any = None, options: dict[str, Any] | None = None) -> None:
        """Send a reset to the workers; arguments as in `SyncTabletopEnvs.reset`."""
        seeds = self._gate.check_reset(seed, options)
        with self._all_or_none():
            super().reset_async(seeds, dict(options or {}))

    def reset_wait(self, timeout: float | None = None) -> tuple[Any, dict[str, Any]]:
        """Wait for the reset."""
        with self._all_or_none():
            result = super().reset_wait(timeout)
        self._gate.note_reset()
        return result

    def step_async(self, actions: Any) -> None:
        """Send a step to the workers; arguments as in `SyncTabletopEnvs.step`."""
        self._gate.check_step(actions)
        with self._all_or_none():
            super().step_async(actions)

    def step_wait(
        self, timeout: float | None = None
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Wait for the step."""
        with self._all_or_none():
            result = super().step_wait(timeout)
        self._gate.note_step(result[2] | result[3])
        return result

    def call_async(self, name: str, /, *args: object, **kwargs: object) -> None:
        """Ask every worker for an attribute, or the result of a method."""
        with self._all_or_none():
            super().call_async(name, *args, **kwargs)

    def call_wait(self, timeout: float | None = None) -> tuple[Any, ...]:
        """Wait for the answers."""
        with self._all_or_none():
            answers = super().call_wait(timeout)
        for index, answer in enumerate(answers):
            if isinstance(answer, _Failed):
                answer.error.add_note(f"raised in sub-environment {index}")
                raise answer.error
        return answers

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """End the workers: at once if asked, or if they are busy; else let them finish by themselves.

        Gymnasium's own version waits for busy workers, and fails if one of them has died.
        """
        self._end_workers(at_once=terminate or self._state != AsyncState.DEFAULT, patience_s=timeout)

    def _check_spaces(self) -> None:
        self._starting.close()  # all workers are on their way, and Ctrl-C may interrupt the wait for them
        with self._all_or_none():
            super()._check_spaces()

    def _raise_if_errors(self, successes: Iterable[bool]) -> None:
        """Raise the first error of a worker; Gymnasium would show it as a warning first."""
        if all(successes):
            return
        try:
            index, _, error, trace = self.error_queue.get(timeout=_PATIENCE_S)
        except queue.Empty:
            raise WorkerError("a worker failed with an error that cannot be sent; see its output.") from None
        error.add_note(f"raised in sub-environment {index}; all workers were ended.\n\n{trace}")
        raise error

    @contextlib.contextmanager
    def _all_or_none(self) -> Iterator[None]:
        """End all workers if the block fails, except if it was only called at the wrong time."""
        try:
            yield
        except (AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError):
            raise
        except (EOFError, ConnectionError):
            message = self._obituary()
            self.close(terminate=True)
            raise WorkerError(message) from None
        except BaseException:
            self.close(terminate=True)
            raise

    def _obituary(self) -> str:
        for process in self.processes:
            process.join(timeout=0.2)  # its exit code may come a little later than the end of its pipe
        codes = [(index, process.exitcode) for index, process in enumerate(self.processes)]
        dead = [f"{index} (exit code {code})" for index, code in codes if code is not None]
        return (
            f"the worker of sub-environment {', '.join(dead) or '?'} ended by itself; all others were ended. "
            "Exit code -9 often means that memory was short; 1 that it could not start: a script must keep "
            'what it does under `if __name__ == "__main__":`, for workers import it.'
        )

    def _end_workers(self, *, at_once: bool, patience_s: float | None = None) -> None:
        pipes = getattr(self, "parent_pipes", [])
        processes = [process for process in getattr(self, "processes", []) if process.pid is not None]
        if not at_once:
            for pipe in pipes:
                with contextlib.suppress(OSError):  # it may have died
                    pipe.send(("close", None))
            for process in processes:
                process.join(_PATIENCE_S if patience_s is None else patience_s)
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()
        for pipe in pipes:
            pipe.close()


_OPEN: weakref.WeakSet[AsyncTabletopEnvs] = weakref.WeakSet()


@atexit.register
def _end_all_workers() -> None:
    """End what a script left open, while the modules that this needs are still there."""
    for envs in list(_OPEN):
        envs.close(terminate=True)


@dataclass(frozen=True, slots=True)
class _Failed:
    """An error instead of an answer."""

    error: Exception


class _Answering(gymnasium.Wrapper):
    """Answers calls with an error instead of raising it, which would end the worker."""

    def close(self) -> None:
        # Gymnasium's worker closes its environment as its last act. If that is because nobody takes its
        # answers any more, the parent has died, and the worker goes without a traceback.
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


def _build(recipe: Callable[[], gymnasium.Env], parent_pid: int) -> gymnasium.Env:
    """Build a sub-environment in a worker; Gymnasium also builds one in the parent, to learn its spaces."""
    if os.getpid() != parent_pid:
        init_worker()
    return _Answering(recipe())
