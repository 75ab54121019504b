"""Several processes of one machine, with the environment in which `torchrun` starts them."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

_STOP_S = 120.0  # of a busy machine


@contextmanager
def joined_by(others: int, arguments: Sequence[str]) -> Iterator[None]:
    """Start further processes, which are this one's peers within the block.

    They write nothing, since this process, the first one, fails as they do. However it ends, they end, too:
    their connection to it is closed.

    Args:
        others: Number of further processes.
        arguments: Of the Python interpreter.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    shared = {"WORLD_SIZE": str(others + 1), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    before = dict(os.environ)
    processes = [
        subprocess.Popen(
            [sys.executable, *arguments],
            env={**before, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for rank in range(1, others + 1)
    ]
    os.environ.update(shared, RANK="0", LOCAL_RANK="0")
    try:
        yield
        for process in processes:
            process.wait(_STOP_S)
    finally:
        os.environ.clear()
        os.environ.update(before)
        for process in processes:
            process.kill()
            process.wait()
