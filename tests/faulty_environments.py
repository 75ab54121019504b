"""Environments that fail; a module of its own because workers import it."""

import os
import time
from typing import Any

import gymnasium

from openvima.env import make
from openvima.errors import SamplingError


class LocalError(Exception):
    """Cannot be sent to another process."""

    def __init__(self) -> None:
        super().__init__(lambda: None)


class Faulty(gymnasium.Wrapper):
    """Fails at seeds 13 (as a task may) and 14 (with an error that cannot be sent); a step takes `step_s`."""

    def __init__(self, step_s: float = 0.0) -> None:
        super().__init__(make("rotate"))
        self.step_s = step_s

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        if seed == 13:
            raise SamplingError("no place for the target")
        if seed == 14:
            raise LocalError
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        time.sleep(self.step_s)
        return super().step(action)


class FailsToStart:
    """Builds an environment in the process that made this object, and in no other."""

    def __init__(self) -> None:
        self.pid = os.getpid()

    def __call__(self) -> gymnasium.Env:
        if os.getpid() != self.pid:
            os._exit(3)
        return make("rotate")
