"""Jobs for worker processes in tests; workers import them from here."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

from openvima.errors import SceneError


def write_number(path: Path, count: Callable[[int], None]) -> None:
    """Write how many threads libraries may use."""
    path.write_text(os.environ["OMP_NUM_THREADS"])
    count(3)


def fail(number: int, count: Callable[[int], None]) -> None:
    """Raise an error of the package for item 1."""
    if number == 1:
        raise SceneError("job 1 fails")


def die(number: int, count: Callable[[int], None]) -> None:
    """Be killed, as by a system short of memory, for item 1."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)


def die_at_first(path: Path, count: Callable[[int], None]) -> None:
    """Be killed, unless the file says that this has happened before."""
    if not path.exists():
        path.write_text("died")
        os.kill(os.getpid(), signal.SIGKILL)
    path.write_text("done")


def note_pid_and_hang(path: Path, count: Callable[[int], None]) -> None:
    """Write the id of the process, then wait to be ended."""
    path.with_suffix(".part").write_text(str(os.getpid()))
    path.with_suffix(".part").rename(path)
    signal.pause()
