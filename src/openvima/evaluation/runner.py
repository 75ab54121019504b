"""Running an evaluation: batches of episodes over worker processes, each kept as it finishes."""

import json
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from openvima.errors import ConfigError, OpenVimaError
from openvima.evaluation.clips import FOLDER
from openvima.evaluation.players import load_player
from openvima.evaluation.protocol import Batch, EvaluationConfig, plan, policy_sources
from openvima.evaluation.results import FILE_NAME, EpisodeOutcome, Results, Row, write_text
from openvima.evaluation.versions import versions
from openvima.tasks.registry import task_spec

Report = Callable[[int, int, str], None]
LOG_NAME = "evaluation_log.json"
_PARTS = "parts"


@dataclass(frozen=True, slots=True)
class Job:
    """A batch to play, with what its outcomes depend on and where they go."""

    batch: Batch
    fingerprint: str
    part: Path


def evaluate(config: EvaluationConfig, report: Report | None = None) -> Path:
    """Score policies on tasks and levels.

    Outcomes of finished batches are kept below `config.out` until all are there, so an interrupted evaluation
    goes on where it stopped. If the folder holds the results of the same evaluation, nothing is played again.

    Args:
        config: What to evaluate.
        report: Called with episodes done, episodes in all and a note on what was played last.

    Returns:
        `results.json` in `config.out`; the files of `openvima.evaluation.finish` are beside it.

    Raises:
        ConfigError: The settings cannot be, or `config.out` holds results of other settings.
        OpenVimaError: A worker process died.
    """
    from openvima.evaluation.finish import finish, require_extra

    if config.report:
        require_extra()
    batches = plan(config)
    policies = {source.name: source.record() for source in policy_sources(config.policies)}
    found = versions(with_torch=any(what["kind"] in ("run", "untrained") for what in policies.values()))
    path = config.out / FILE_NAME
    results = _earlier(path, config, policies, found)
    if results is None:
        started = time.perf_counter()
        outcomes = _play_all(config, batches, policies, found, report)
        results = Results(_rows(batches, outcomes), config.record(), found, policies)
        results.write(path)
        _write_log(config, results, time.perf_counter() - started)
        shutil.rmtree(config.out / _PARTS, ignore_errors=True)
    if config.report:
        episodes = sum(batch.episodes for batch in batches)
        finish(config, results, None if report is None else lambda note: report(episodes, episodes, note))
    return path


def _earlier(
    path: Path, config: EvaluationConfig, policies: Mapping[str, Any], found: Mapping[str, str]
) -> Results | None:
    """Results of the same evaluation that are there already, if any."""
    if not path.exists() or config.force:
        return None
    earlier = Results.read(path)
    if (earlier.config, earlier.policies, earlier.versions) == (config.record(), policies, found):
        return earlier
    raise ConfigError(
        f"{path} holds another evaluation (its settings, weights or versions differ). "
        "Choose another --out, or give --force to overwrite it."
    )


def _play_all(
    config: EvaluationConfig,
    batches: Sequence[Batch],
    policies: Mapping[str, Mapping[str, str]],
    found: Mapping[str, str],
    report: Report | None,
) -> dict[Batch, tuple[EpisodeOutcome, ...]]:
    """Play what has not been played yet."""
    parts = config.out / _PARTS
    parts.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(config.out / FOLDER, ignore_errors=True)  # films of other results
    jobs = []
    for batch in batches:
        fingerprint = json.dumps([policies[batch.policy], dict(found)], sort_keys=True)
        jobs.append(Job(batch, fingerprint, parts / f"{batch.key(fingerprint)}.json"))
    total, done = sum(batch.episodes for batch in batches), 0
    outcomes: dict[Batch, tuple[EpisodeOutcome, ...]] = {}
    for job in jobs:
        if (kept := _kept(job)) is not None:
            outcomes[job.batch] = kept
            done += job.batch.episodes
    if report is not None:
        report(done, total, "")
    todo = [job for job in jobs if job.batch not in outcomes]
    for job, played in in_workers(play_batch, todo, workers=config.workers):
        outcomes[job.batch] = played
        done += job.batch.episodes
        if report is not None:
            report(done, total, f"{job.batch.policy} {job.batch.task} {job.batch.level}")
    return outcomes


def play_batch(job: Job) -> tuple[EpisodeOutcome, ...]:
    """Play one batch and keep its outcomes; runs in a worker process."""
    from openvima.env.tabletop import TabletopEnv
    from openvima.evaluation.rollout import play

    batch = job.batch
    with one_thread(batch):
        player = load_player(batch, job.fingerprint)
        envs = [
            TabletopEnv(batch.task, level=batch.level, domain="eval", assets=batch.assets)
            for _ in batch.seeds
        ]
        outcomes = tuple(play(envs, batch.seeds, player))
    write_text(job.part, json.dumps([asdict(outcome) for outcome in outcomes], ensure_ascii=False) + "\n")
    return outcomes


@contextmanager
def one_thread(batch: Batch) -> Iterator[None]:
    """Keep torch to one thread: sums in another order would change the last bits of what a network gives."""
    if batch.source in ("oracle", "random"):  # no network
        yield
        return
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def in_workers(
    function: Callable[[Any], Any], jobs: Sequence[Any], *, workers: int
) -> Iterator[tuple[Any, Any]]:
    """Apply a function to jobs in worker processes, or here if one is enough.

    Args:
        function: A function of a module; it and the jobs are sent to other processes.
        jobs: Its arguments, one each.
        workers: Number of processes.

    Yields:
        A job and its result, as they finish.

    Raises:
        OpenVimaError: A process died.
    """
    workers = min(workers, len(jobs))
    if workers <= 1:
        yield from ((job, function(job)) for job in jobs)
        return
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_ignore_interrupts)
    try:
        yield from _as_they_finish(pool, function, jobs)
    except BrokenProcessPool as error:
        raise OpenVimaError(
            "a worker process died, perhaps for want of memory. What was finished is kept: run the same "
            "command again, with fewer --workers if it happens again."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _as_they_finish(
    pool: Executor, function: Callable[[Any], Any], jobs: Sequence[Any]
) -> Iterator[tuple[Any, Any]]:
    futures: dict[Future[Any], Any] = {pool.submit(function, job): job for job in jobs}
    for future in as_completed(futures):
        yield futures[future], future.result()


def _ignore_interrupts() -> None:
    """Leave Ctrl-C to the main process, which lets the workers finish their batches."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _kept(job: Job) -> tuple[EpisodeOutcome, ...] | None:
    """Outcomes of a batch from an interrupted run; None if there are none, or no usable ones."""
    try:
        records = json.loads(job.part.read_text(encoding="utf-8"))
        outcomes = tuple(EpisodeOutcome(**record) for record in records)
    except (OSError, ValueError, TypeError):
        return None
    return outcomes if [outcome.seed for outcome in outcomes] == list(job.batch.seeds) else None


def _rows(batches: Sequence[Batch], outcomes: Mapping[Batch, tuple[EpisodeOutcome, ...]]) -> tuple[Row, ...]:
    """Join the batches of each policy, task and level."""
    joined: dict[tuple[str, str, str], list[EpisodeOutcome]] = {}
    for batch in batches:
        joined.setdefault((batch.policy, batch.task, batch.level), []).extend(outcomes[batch])
    return tuple(
        Row(policy, task, level, task_spec(task).oracle_max_steps, tuple(played))
        for (policy, task, level), played in joined.items()
    )


def _write_log(config: EvaluationConfig, results: Results, seconds: float) -> None:
    """Write what depends on the machine and the time, apart from the results."""
    episodes = sum(row.episodes for row in results.rows)
    record = {
        "episodes": episodes,
        "seconds": round(seconds, 3),
        "workers": config.workers,
        "policies": {source.name: source.source for source in policy_sources(config.policies)},
    }
    write_text(config.out / LOG_NAME, json.dumps(record, indent=1) + "\n")
