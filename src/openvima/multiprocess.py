"""Parallel jobs in worker processes with one thread each."""

import contextlib
import math
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import Any, Protocol

from openvima.errors import ConfigError, WorkerError

POLL_S = 0.2
PARENT_END_S = 5.0  # grace period for the parent to exit
MAX_WORKERS = 1024
WORKER_VARIABLES = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    # By default glibc returns the memory of freed arrays to the system, which clears that of the next ones
    # anew: 4 % of an evaluation.
    "MALLOC_MMAP_THRESHOLD_": str(2**25),
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
}
_KILLED = (
    "a worker process was killed (often for lack of memory; --workers lowers the need). "
    "Whole files were kept, and the same command continues."
)
_NOT_STARTED = (
    "the worker processes could not start. They import your script, which must be a file where all that runs "
    'stands below `if __name__ == "__main__":`; workers=1 needs no such process.'
)
# In a worker: the shared array of counts. Any: multiprocessing has no public type for it.
_counters: Any = None

Counts = Sequence[Sequence[int]]
"""The numbers last passed to `count`, one row per job; zeros before it starts."""


class Job(Protocol):
    """A function of one item that calls `count` with the number of things done so far."""

    def __call__(self, item: Any, count: Callable[..., None], /) -> Any:  # Any: up to the caller
        """Run the job."""


def imap_unordered(
    job: Job, items: Sequence[Any], num_workers: int, *, report: Callable[[int], None] | None = None
) -> Iterator[tuple[Any, Any]]:
    """Apply a job to every item and yield the results as they finish.

    Args:
        job: A function of a module (workers import it).
        items: Its arguments; they and the results are pickled.
        num_workers: Number of processes; 1 runs everything in this process.
        report: Called repeatedly with the sum of all counts.

    Yields:
        An item and its result, as they finish.

    Raises:
        ConfigError: `num_workers` is out of range.
        WorkerError: A worker was killed, or none could start.
        Exception: Any exception of a job; the other jobs are stopped.
    """
    watch = None if report is None else (lambda counts: report(sum(row[0] for row in counts)))
    yield from imap_with_progress(job, items, num_workers, watch=watch)


def imap_with_progress(
    job: Job,
    items: Sequence[Any],
    num_workers: int,
    *,
    num_counts: int = 1,
    watch: Callable[[Counts], None] | None = None,
) -> Iterator[tuple[Any, Any]]:
    """Like `imap_unordered`, with separate counts for each job.

    Args:
        job: Calls `count` with `num_counts` numbers.
        items: Its arguments.
        num_workers: Number of processes.
        num_counts: Numbers that a job counts.
        watch: Called repeatedly with the counts of all jobs, in the order of the items.

    Yields:
        An item and its result, as they finish.
    """
    check_workers(num_workers)
    watch = watch or (lambda counts: None)
    if num_workers == 1 or len(items) <= 1:
        yield from _run_serially(job, items, num_counts, watch)
        return
    context = multiprocessing.get_context("spawn")
    # One row per job, and whether a worker has started: no lock that a killed worker could hold.
    counters = context.RawArray("q", len(items) * num_counts + 1)
    others = set(multiprocessing.active_children())
    with single_threaded_workers():
        pool = ProcessPoolExecutor(
            min(num_workers, len(items)), mp_context=context, initializer=_start_worker, initargs=(counters,)
        )
        try:
            pending = {
                pool.submit(_run_one, job, item, slot, num_counts): item for slot, item in enumerate(items)
            }
            while pending:
                done, _ = wait(pending, timeout=POLL_S, return_when=FIRST_COMPLETED)
                for future in done:
                    yield pending.pop(future), future.result()
                watch(_rows(counters, num_counts))
        except BrokenProcessPool:
            raise WorkerError(_KILLED if counters[-1] else _NOT_STARTED) from None
        except BaseException:  # a job's own error, or Ctrl-C
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


def num_cpus() -> int:
    """Return how many CPUs this process may use; the quota of a container counts."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(
        1, min([count, *map(math.ceil, _cpu_quotas(Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")))])
    )


def _cpu_quotas(mounted: Path, own: Path) -> Iterator[float]:
    """Yield the CPUs that the control groups of this process may use, where they are limited.

    Args:
        mounted: Where the groups are mounted; in a container that of the process may be this one itself.
        own: The file that names the groups of this process, as HIERARCHY:CONTROLLERS:PATH.
    """
    with contextlib.suppress(OSError, ValueError):
        for line in own.read_text(encoding="utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers and "cpu" not in controllers.split(","):
                continue
            for root in (mounted / controllers, mounted / ("cpu" if controllers else "unified")):
                group = root / path.strip("/")
                for folder in (group, *group.parents):
                    if folder.is_relative_to(root):
                        yield from _quota_of(folder)


def _quota_of(group: Path) -> Iterator[float]:
    """Yield the CPUs of one control group, of version 2 or 1, if they are limited."""
    with contextlib.suppress(OSError, ValueError):
        quota, period = (group / "cpu.max").read_text(encoding="utf-8").split()
        yield int(quota) / int(period)  # "max" is no number
    with contextlib.suppress(OSError, ValueError):
        quota, period = (
            int((group / f"cpu.cfs_{name}_us").read_text("utf-8")) for name in ("quota", "period")
        )
        if quota > 0:
            yield quota / period


def check_workers(num_workers: int) -> None:
    """Check the number of processes.

    Raises:
        ConfigError: It is out of range.
    """
    if not 1 <= num_workers <= MAX_WORKERS:
        raise ConfigError(f"workers is {num_workers}; it must lie within 1 … {MAX_WORKERS}.")


def _run_serially(
    job: Job, items: Sequence[Any], num_counts: int, watch: Callable[[Counts], None]
) -> Iterator[tuple[Any, Any]]:
    counts: list[tuple[int, ...]] = [(0,) * num_counts] * len(items)
    for slot, item in enumerate(items):

        def count(*numbers: int, slot: int = slot) -> None:
            counts[slot] = numbers
            watch(counts)

        yield item, job(item, count)


@contextlib.contextmanager
def single_threaded_workers() -> Iterator[None]:
    """Give processes that start inside the block `WORKER_VARIABLES`: one thread, and memory that is kept."""
    before = {name: os.environ.get(name) for name in WORKER_VARIABLES}
    os.environ.update(WORKER_VARIABLES)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def defer_sigint() -> Iterator[None]:
    """Defer SIGINT to the end of the block; processes that start inside never receive it.

    Ctrl-C reaches every process of a terminal, so a worker that is still importing would print a traceback.
    No effect on Windows.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # its start unblocks signals
    pending: list[int] = []
    # Blocking covers this thread and the processes that it starts. Another thread, such as one of a BLAS
    # library, may still receive the signal; Python then runs the handler here.
    in_main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, lambda number, frame: pending.append(number)) if in_main else None
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if in_main:
            signal.signal(signal.SIGINT, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if pending:
            signal.raise_signal(signal.SIGINT)


def init_worker() -> None:
    """Initialise a worker: ignore SIGINT, and exit with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=exit_with_parent, args=(None,), daemon=True).start()


def exit_with_parent(timeout_s: float | None = PARENT_END_S) -> None:
    """Exit this worker once its parent has exited.

    Args:
        timeout_s: How long to wait for that; None waits for ever.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None  # this only runs in workers
    if wait_for([parent.sentinel], timeout_s):
        os._exit(1)


def _start_worker(counters: Any) -> None:  # Any: see `_counters`
    global _counters
    _counters = counters
    counters[-1] = 1
    init_worker()


def _run_one(job: Job, item: Any, slot: int, num_counts: int) -> Any:  # Any: see `Job`
    first = slot * num_counts

    def count(*numbers: int) -> None:
        _counters[first : first + num_counts] = numbers

    return job(item, count)


def _rows(counters: Any, num_counts: int) -> Counts:  # Any: see `_counters`
    flat = counters[:-1]
    return [flat[first : first + num_counts] for first in range(0, len(flat), num_counts)]
