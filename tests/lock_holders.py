"""A process that holds the lock of a folder, for tests of what others then may do."""

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

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
