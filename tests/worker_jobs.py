"""Work that tests give to other processes: jobs, and holders of locks."""

import contextlib
import gc
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
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


def forget_ray() -> None:
    """Collect what Ray leaves: it does not wait for processes that it ends, and Python warns of them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


_SCRIPT = """
import sys
from pathlib import Path
from openvima.atomic_io import folder_lock

part = (int(sys.argv[2]), int(sys.argv[3])) if len(sys.argv) > 2 else None
with folder_lock(Path(sys.argv[1]), part):
    print("locked", flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def holding(folder: Path, *part: int) -> Iterator[subprocess.Popen]:
    """Hold the lock, or that of a part, until the block ends or the process's standard input is closed."""
    words = [sys.executable, "-c", _SCRIPT, str(folder), *map(str, part)]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "locked\n"
        yield process
    finally:
        process.stdin.close()
        process.wait()
        process.stdout.close()
