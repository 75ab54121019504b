"""Parallel jobs on a Ray cluster with one thread each; the counterpart of `openvima.multiprocess`.

The only module that imports Ray: `pip install openvima[scale]`.
"""

import contextlib
import importlib
import os
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import Any

from openvima.errors import ConfigError, WorkerError
from openvima.extras import import_extra
from openvima.multiprocess import WORKER_VARIABLES, Counts, Job, num_cpus

POLL_S = 0.5
COUNT_INTERVAL_S = 1.0  # one message per job and second
CANCEL_S = 20.0  # for jobs to end after an error or Ctrl-C
CONNECT_S = 10.0
RETRIES = 2  # of a job whose machine or process died
OBJECT_STORE_BYTES = 100 * 2**20  # Ray's default is 30 % of the memory; results are files here
AUTO = "auto"  # the cluster that this machine belongs to


def ray_imap_unordered(
    job: Job,
    items: Sequence[Any],
    num_workers: int | None,
    *,
    address: str | None = None,
    num_counts: int = 1,
    watch: Callable[[Counts], None] | None = None,
) -> Iterator[tuple[Any, Any]]:
    """Apply a job to every item on a Ray cluster and yield the results as they finish.

    A job whose machine or process died runs again elsewhere, up to `RETRIES` times, so jobs must be
    repeatable.

    Args:
        job: A function of a module that every machine can import.
        items: Its arguments, taken in order; they and the results are pickled.
        num_workers: Concurrent jobs; None: one per CPU of the cluster.
        address: "HOST:PORT" of the cluster's head, "ray://HOST:PORT", or "auto". None uses the Ray
            session of this process, or starts one on this machine and stops it at the end.
        num_counts: Numbers that a job counts.
        watch: Called repeatedly with the counts of all jobs, in the order of the items.

    Yields:
        An item and its result, as they finish.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: No cluster answers at the address, it has another version of Ray or Python, or it lacks
            the job's module.
        WorkerError: A job died each time.
        Exception: Any exception of a job; the other jobs are stopped.
    """
    ray = _import_ray()
    with _connected(ray, address, num_workers):
        yield from _run_all(ray, job, items, num_workers or len(items), num_counts, watch or (lambda _: None))


def _import_ray() -> ModuleType:
    # Read when Ray is imported: no usage statistics, no deprecation warnings.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    return import_extra(
        "ray",
        "running on a Ray cluster needs ray: pip install openvima[scale]. "
        "Without it, --engine processes uses the CPUs of this machine.",
    )


@contextlib.contextmanager
def _connected(ray: ModuleType, address: str | None, num_workers: int | None) -> Iterator[None]:
    """Connect to a cluster, or start one on this machine and stop it afterwards."""
    if address is None and ray.is_initialized():
        yield
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}  # Any: options of `ray.init`
    if address is None:
        options |= {
            "address": "local",
            "num_cpus": num_workers or num_cpus(),
            "include_dashboard": False,
            "object_store_memory": OBJECT_STORE_BYTES,
        }
    else:
        _check_answers(address)
        options["address"] = address
    try:
        ray.init(**options)
    except (ConnectionError, RuntimeError, ValueError) as error:
        hint = " If it asks for a token, RAY_AUTH_TOKEN must hold it here too." if address else ""
        raise ConfigError(
            f"cannot use Ray at {address or 'this machine'}: {_first_line(error)}.{hint}"
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


def _check_answers(address: str) -> None:
    """Probe a HOST:PORT: Ray itself waits for minutes, then ends the process without an exception."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if address == AUTO:
        return
    if not host or not port.isdigit():
        raise ConfigError(f"address is {address!r}; allowed are HOST:PORT, ray://HOST:PORT and {AUTO!r}.")
    try:
        socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"no Ray cluster answers at {address} ({error}); `ray status` on its head shows the address."
        ) from None


def _run_all(
    ray: ModuleType,
    job: Job,
    items: Sequence[Any],
    num_workers: int,
    num_counts: int,
    watch: Callable[[Counts], None],
) -> Iterator[tuple[Any, Any]]:
    counts: list[tuple[int, ...]] = [(0,) * num_counts] * len(items)
    # On the machine of this process, without which nothing goes on anyway.
    strategies = importlib.import_module("ray.util.scheduling_strategies")
    here = strategies.NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    progress = ray.remote(num_cpus=0, scheduling_strategy=here)(_ProgressActor).remote()
    # Ray's own retries have no limit where memory runs out.
    remote = ray.remote(num_cpus=1, max_retries=0, runtime_env={"env_vars": _environment()})(_run_one)
    waiting, running, deaths = deque(range(len(items))), {}, Counter[int]()
    try:
        while True:
            while len(running) < num_workers and waiting:
                slot = waiting.popleft()
                running[remote.remote(job, items[slot], slot, progress)] = slot
            if not running:
                return
            done, _ = ray.wait(list(running), timeout=POLL_S)
            for reference in done:
                slot = running.pop(reference)
                try:
                    result, numbers = ray.get(reference)
                except _lost(ray):
                    deaths[slot] += 1
                    if deaths[slot] > RETRIES:
                        raise
                    waiting.appendleft(slot)
                    continue
                counts[slot] = numbers or counts[slot]
                yield items[slot], result
            for slot, numbers in ray.get(progress.read.remote()).items():
                if slot in running.values():
                    counts[slot] = numbers
            watch(counts)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, ray.exceptions.RayError):  # the job could not be unpickled
            raise ConfigError(
                f"a machine of the Ray cluster cannot do the work ({_first_line(error.cause)}). "
                "All of them need this version of openvima, with what its extras and your tasks import."
            ) from None
        raise error.cause from None  # what the job raised
    except ray.exceptions.RayError as error:
        raise WorkerError(
            f"a worker of the Ray cluster died ({_first_line(error)}); often for lack of memory. "
            "Whole files were kept, and the same command continues."
        ) from None
    finally:
        _stop(ray, list(running))


def _lost(ray: ModuleType) -> tuple[type[Exception], ...]:
    """What Ray raises where a process or machine died, alone or with a result that was still on it."""
    errors = ray.exceptions
    return errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError, errors.ObjectLostError


def _stop(ray: ModuleType, references: list[Any]) -> None:  # Any: Ray's references
    """Cancel jobs and wait for their clean-up."""
    if not references:
        return
    with contextlib.suppress(ray.exceptions.RayError):
        for reference in references:
            ray.cancel(reference)
        ray.wait(references, num_returns=len(references), timeout=CANCEL_S)


def _environment() -> dict[str, str]:
    """Environment of the workers: one thread each, and this package's variables."""
    own = {name: value for name, value in os.environ.items() if name.startswith("OPENVIMA_")}
    return {**own, **WORKER_VARIABLES}


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0].strip().rstrip(".")


class _ProgressActor:
    """Actor that holds the counts of running jobs."""

    def __init__(self) -> None:
        self._counts: dict[int, tuple[int, ...]] = {}

    def write(self, slot: int, numbers: tuple[int, ...]) -> None:
        self._counts[slot] = numbers

    def read(self) -> dict[int, tuple[int, ...]]:
        return self._counts


def _run_one(job: Job, item: Any, slot: int, progress: Any) -> tuple[Any, tuple[int, ...]]:  # Any: see `Job`
    """Run a job in a worker; return its result and its last counts."""
    last: tuple[int, ...] = ()
    next_s = 0.0

    def count(*numbers: int) -> None:
        nonlocal last, next_s
        last = numbers
        if time.monotonic() >= next_s:
            next_s = time.monotonic() + COUNT_INTERVAL_S
            progress.write.remote(slot, numbers)

    return job(item, count), last
