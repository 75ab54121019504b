"""SIGTERM, with which schedulers and containers end a training, as a wish that steps can be asked about."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def noted_sigterm() -> Iterator[Callable[[], bool]]:
    """Let SIGTERM end nothing within the block.

    Yields:
        A function that tells whether the signal came. In another thread than the main one, and where the
        caller's program handles the signal itself, it comes never, and acts as outside of the block.
    """
    came: list[int] = []
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield lambda: False
        return
    signal.signal(signal.SIGTERM, lambda number, frame: came.append(number))
    try:
        yield lambda: bool(came)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
