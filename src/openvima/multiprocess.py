"""Parallel jobs with one thread each: in processes of this machine, or on a Ray cluster.

Only the engine "ray" imports Ray: `pip install openvima[scale]`.
"""

import contextlib
import math
import multiprocessing
import os
import signal
import socket
import threading
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from types import ModuleType
from typing import Any

from openvima.errors import ConfigError, UnknownWordWarning, WorkerError, handle_unknown_words, one_line
from openvima.imports import import_extra

POLL_S = 0.2
MAX_WORKERS = 1024
_CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
WORKER_VARIABLES = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    # By default glibc returns the memory of freed arrays to the system, which clears that of the next ones
    # anew: 4 % of an evaluation.
    "MALLOC_MMAP_THRESHOLD_": str(2**25),
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
}
_KILLED = (
    "a worker process was killed (often for lack of memory; --workers lowers the need). "
    "Finished files are kept; repeat the command to resume."
)
_NOT_STARTED = (
    "the worker processes could not start. They import your script, which must be a file where all that runs "
    'stands below `if __name__ == "__main__":`; workers=1 needs no such process.'
)
# In a worker: the shared array of counts.
_counters: Any = None

Report = Callable[[int, int, str], None]
"""Called with the number of things done, that of all, and a note."""


Job = Callable[[Any, Callable[[int], None]], Any]
"""A function of one item that calls its second argument with the number of things done so far."""


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
    check_workers(num_workers)
    report = report or (lambda done: None)
    if num_workers == 1 or len(items) <= 1:
        counts = list[int]()

        def count(number: int) -> None:
            counts[-1] = number
            report(sum(counts))

        for item in items:
            counts.append(0)
            yield item, job(item, count)
        return
    context = multiprocessing.get_context("spawn")
    # One number per job, and whether a worker has started: no lock that a killed worker could hold.
    counters = context.RawArray("q", len(items) + 1)
    others = set(multiprocessing.active_children())
    with single_threaded_workers():
        pool = ProcessPoolExecutor(
            min(num_workers, len(items)), mp_context=context, initializer=_start_worker, initargs=(counters,)
        )
        try:
            pending = {pool.submit(_run_one, job, item, slot): item for slot, item in enumerate(items)}
            while pending:
                done, _ = wait(pending, timeout=POLL_S, return_when=FIRST_COMPLETED)
                for future in done:
                    result, found = future.result()
                    _warn(found)
                    yield pending.pop(future), result
                report(sum(counters[:-1]))
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
    count = len(os.sched_getaffinity(0))
    with contextlib.suppress(OSError, ValueError):
        quota, period = _CPU_QUOTA.read_text(encoding="utf-8").split()
        count = min(count, math.ceil(int(quota) / int(period)))  # "max" is no number
    return count


def check_workers(num_workers: int) -> None:
    """Check the number of processes.

    Raises:
        ConfigError: It is out of range.
    """
    if not 1 <= num_workers <= MAX_WORKERS:
        raise ConfigError(f"workers is {num_workers}; it must lie within 1 … {MAX_WORKERS}.")


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
    """
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
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # this only runs in workers
    wait_for([parent.sentinel])
    os._exit(1)


def _start_worker(counters: Any) -> None:
    global _counters
    _counters = counters
    counters[-1] = 1
    init_worker()


def _run_one(job: Job, item: Any, slot: int) -> tuple[Any, list[UnknownWordWarning]]:
    """Run a job in a worker; return its result, and the unknown words to warn of where all come together."""
    found = list[UnknownWordWarning]()
    with handle_unknown_words(found.append):
        return job(item, partial(_counters.__setitem__, slot)), found


def _warn(found: Sequence[UnknownWordWarning]) -> None:
    """Warn in this process of what a worker found."""
    for warning in found:
        warnings.warn(warning, stacklevel=3)


RAY_POLL_S = 0.5
CANCEL_S = 20.0  # for jobs to end after an error or Ctrl-C
CONNECT_S = 10.0
RETRIES = 2  # of a job whose machine or process died
OBJECT_STORE_BYTES = 100 * 2**20  # Ray's default is 30 % of the memory; results are files here


def engine_problems(engine: str, address: str | None) -> Iterator[str]:
    """Say what is wrong with an engine, "processes" or "ray", and with the address of its cluster."""
    if engine not in ("processes", "ray"):
        yield f"engine is {engine!r}; allowed are processes and ray."
    elif address is not None and engine != "ray":
        yield f"address is {address!r}, but the engine is {engine!r}; only 'ray' takes one."


def imap_with_engine(
    engine: str,
    job: Job,
    items: Sequence[Any],
    num_workers: int | None,
    *,
    address: str | None = None,
    report: Callable[[int], None] | None = None,
) -> Iterator[tuple[Any, Any]]:
    """Apply a job to every item with "processes" of this machine or with "ray", and yield the results.

    A job whose machine or process died runs again elsewhere on a Ray cluster, up to `RETRIES` times, so jobs
    must be repeatable.

    Args:
        engine: "processes" or "ray".
        job: A function of a module that every machine can import.
        items: Its arguments, taken in order; they and the results are pickled.
        num_workers: Concurrent jobs; None: one, or one per CPU of the cluster at `address`.
        address: "HOST:PORT" of the cluster's head. None uses the Ray session of this process, or starts one
            on this machine and stops it at the end.
        report: Called repeatedly with the sum of the counts; with "ray" with that of finished jobs.

    Yields:
        An item and its result, as they finish.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: No cluster answers at the address, it has another version of Ray or Python, or it lacks
            the job's module.
        WorkerError: A job died each time.
        Exception: Any exception of a job; the other jobs are stopped.
    """
    if engine == "processes":
        yield from imap_unordered(job, items, num_workers or 1, report=report)
        return
    # Read when Ray is imported: no usage statistics, no deprecation warnings.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    ray = import_extra(
        "ray",
        "running on a Ray cluster needs ray: pip install openvima[scale]. "
        "Without it, --engine processes uses the CPUs of this machine.",
    )
    num_workers = num_workers or (1 if address is None else None)
    with _connected(ray, address, num_workers):
        yield from _run_all(ray, job, items, num_workers or len(items), report or (lambda done: None))


@contextlib.contextmanager
def _connected(ray: ModuleType, address: str | None, num_workers: int | None) -> Iterator[None]:
    """Connect to a cluster, or start one on this machine and stop it afterwards."""
    if address is None and ray.is_initialized():
        yield
        return
    options = {"address": address or "local", "log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        options |= {
            "num_cpus": num_workers or num_cpus(),
            "include_dashboard": False,
            "object_store_memory": OBJECT_STORE_BYTES,
        }
    else:
        host, _, port = address.rpartition(":")
        try:  # Ray itself waits for minutes, then ends the process without an exception
            socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
        except (OSError, OverflowError, ValueError) as error:
            raise ConfigError(
                f"no Ray cluster answers at {address} ({error}); `ray status` on its head shows the address, "
                "HOST:PORT."
            ) from None
    try:
        ray.init(**options)
    except (ConnectionError, RuntimeError, ValueError) as error:
        hint = " If it asks for a token, RAY_AUTH_TOKEN must hold it here too." if address else ""
        raise ConfigError(
            f"cannot use Ray at {address or 'this machine'}: {one_line(error)}.{hint}"
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


def _run_all(
    ray: ModuleType,
    job: Job,
    items: Sequence[Any],
    num_workers: int,
    report: Callable[[int], None],
) -> Iterator[tuple[Any, Any]]:
    total, errors = 0, ray.exceptions
    # What Ray raises where a process or machine died, alone or with a result that was still on it.
    lost = errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError, errors.ObjectLostError
    own = {name: value for name, value in os.environ.items() if name.startswith("OPENVIMA_")}
    # Ray shares workers between equal environments. One that was cancelled may have stopped in the middle of
    # an import or a compilation, so each call has workers of its own.
    environment = {**own, **WORKER_VARIABLES, "OPENVIMA_CALL": str(time.time_ns())}
    # Ray's own retries have no limit where memory runs out.
    remote = ray.remote(num_cpus=1, max_retries=0, runtime_env={"env_vars": environment})(_run_counted)
    waiting, running, deaths = deque(range(len(items))), {}, Counter[int]()
    try:
        while True:
            while len(running) < num_workers and waiting:
                slot = waiting.popleft()
                running[remote.remote(job, items[slot], os.getcwd())] = slot
            if not running:
                return
            done, _ = ray.wait(list(running), timeout=RAY_POLL_S)
            for reference in done:
                slot = running.pop(reference)
                try:
                    result, number, found = ray.get(reference)
                except lost:
                    deaths[slot] += 1
                    if deaths[slot] > RETRIES:
                        raise
                    waiting.appendleft(slot)
                    continue
                _warn(found)
                total += number
                yield items[slot], result
            report(total)
    except errors.RayTaskError as error:
        if isinstance(error.cause, errors.RayError):  # the job could not be unpickled
            raise ConfigError(
                f"a machine of the Ray cluster cannot do the work ({one_line(error.cause)}). "
                "All of them need this version of openvima, with what its extras and your tasks import."
            ) from None
        raise error.cause from None  # what the job raised
    except errors.RayError as error:
        raise WorkerError(
            f"a worker of the Ray cluster died ({one_line(error)}); often for lack of memory. "
            "Finished files are kept; repeat the command to resume."
        ) from None
    finally:
        with contextlib.suppress(errors.RayError):
            for reference in running:
                ray.cancel(reference)
            if running:  # wait for their clean-up
                ray.wait(list(running), num_returns=len(running), timeout=CANCEL_S)


def _run_counted(job: Job, item: Any, folder: str) -> tuple[Any, int, list[UnknownWordWarning]]:
    """Run a job in a worker; return its result, its last count and its unknown words.

    Relative paths are those of the folder, where the worker's machine has it.
    """
    with contextlib.suppress(OSError):
        os.chdir(folder)
    counts, found = [0], list[UnknownWordWarning]()
    with handle_unknown_words(found.append):
        return job(item, counts.append), counts[-1], found
