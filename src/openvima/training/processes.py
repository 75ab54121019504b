"""Several processes of one machine, with the environment in which `torchrun` starts them."""

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress

_STOP_S = 120.0  # of a busy machine
_NOTICE_S = 2.0
_NUM_NOTED = 2000  # characters


@contextmanager
def joined_by(others: int, arguments: Sequence[str]) -> Iterator[None]:
    """Start further processes, which are this one's peers within the block.

    They write nothing, since this process, the first one, fails as they do; if one fails by itself, the error
    here has a note with what it wrote last. However this one ends, they end, too: their connection is closed.

    Args:
        others: Number of further processes.
        arguments: Of the Python interpreter.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    shared = {"WORLD_SIZE": str(others + 1), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    before = dict(os.environ)
    with ExitStack() as stack:
        logs = [stack.enter_context(tempfile.TemporaryFile()) for _ in range(others)]
        processes = [
            subprocess.Popen(
                [sys.executable, *arguments],
                env={**before, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=log,
            )
            for rank, log in enumerate(logs, start=1)
        ]
        os.environ.update(shared, RANK="0", LOCAL_RANK="0")
        try:
            yield
            for process in processes:
                process.wait(_STOP_S)
        except Exception as error:
            for rank, (process, log) in enumerate(zip(processes, logs, strict=True), start=1):
                with suppress(subprocess.TimeoutExpired):
                    if process.wait(_NOTICE_S):
                        log.seek(0)
                        written = log.read().decode(errors="replace")[-_NUM_NOTED:]
                        error.add_note(
                            f"process {rank} had ended with status {process.returncode}:\n{written}"
                        )
            raise
        finally:
            os.environ.clear()
            os.environ.update(before)
            for process in processes:
                process.kill()
                process.wait()
