"""What follows an evaluation's results: films of a few episodes, and the report."""

import importlib.util
import shlex
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from openvima.errors import MissingExtraError
from openvima.evaluation.clips import Clip, load_clips, png, save_clips
from openvima.evaluation.protocol import DEFAULT_BATCH, Batch, EvaluationConfig, PolicySource, policy_sources
from openvima.evaluation.results import Results, Row
from openvima.processes import in_processes

REPORT_NAME = "report.html"
_METRICS = "metrics.jsonl"  # what a training run writes into its folder


@dataclass(frozen=True, slots=True)
class FilmJob:
    """One episode to film: a batch of one, under the name that its policy bears in the results."""

    batch: Batch
    fingerprint: str


def require_extra() -> None:
    """Check, before any work, that films and charts can be made.

    Raises:
        MissingExtraError: They cannot.
    """
    missing = [name for name in ("matplotlib", "av") if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingExtraError(
            f"the report needs {' and '.join(missing)}; install with: pip install 'openvima[report]', "
            "or evaluate with --no-report."
        )


def finish(config: EvaluationConfig, results: Results, note: Callable[[str], None] | None = None) -> Path:
    """Film some of the episodes and write `report.html`.

    Args:
        config: The evaluation's settings.
        results: What it found.
        note: Called after each film with what was done.

    Returns:
        The report.
    """
    from openvima.evaluation.report import write_report

    clips = load_clips(config.out)
    jobs = film_jobs(config, results)
    if not clips and jobs:
        filmed = {}
        for job, clip in in_processes(film, jobs, config.workers):
            filmed[job] = clip
            if note is not None:
                note(f"filmed {len(filmed)} of {len(jobs)}")
        clips = [filmed[job] for job in jobs]
        save_clips(clips, config.out)
    sources = policy_sources(config.policies)
    return write_report(
        results,
        config.out / REPORT_NAME,
        command=command_of(config),
        metrics=find_metrics(sources),
        clips=clips,
    )


def film_jobs(config: EvaluationConfig, results: Results) -> list[FilmJob]:
    """Choose which episodes to film, without looking at them.

    Of each task at the first level that holds it: the first `config.videos` solved episodes of every trained
    policy and of the oracle, and as many unsolved ones of trained policies. Where there are neither trained
    policies nor the oracle, of all policies.
    """
    sources = policy_sources(config.policies)
    worth = [source for source in sources if source.kind in ("run", "oracle")] or sources
    jobs = []
    for source in worth:
        for task in results.tasks():
            levels = (results.row(source.name, task, level) for level in results.levels())
            row = next((row for row in levels if row is not None), None)
            if row is not None:
                seeds = _seeds_to_film(row, config.videos, unsolved=source.kind != "oracle")
                fingerprint = str(results.policies.get(source.name))
                jobs += [FilmJob(_single(row, source, seed, config), fingerprint) for seed in seeds]
    return jobs


def film(job: FilmJob, count: Callable[[int], None]) -> Clip:
    """Film one episode; runs in a worker process."""
    from PIL import Image

    from openvima.evaluation.film import Artist, film_episode
    from openvima.evaluation.players import load_player, one_thread
    from openvima.evaluation.prompt_strip import thumbnail

    batch = job.batch
    env = batch.setup.make(batch.task, batch.level, domain="eval", realtime=True)
    env.reset(seed=batch.first_seed)
    poster = png(Image.fromarray(Artist(env, enlarge=2).draw(env.scene)))
    prompt = tuple(part if isinstance(part, str) else png(thumbnail(part)) for part in env.prompt.sequence())
    with tempfile.TemporaryDirectory() as folder, one_thread(batch):
        path = Path(folder, "film.mp4")
        player = load_player(batch, job.fingerprint)
        outcome = film_episode(env, player, batch.first_seed, path, with_prompt=False)
        video = path.read_bytes()
    count(1)
    return Clip(
        policy=batch.policy,
        task=batch.task,
        level=batch.level,
        seed=batch.first_seed,
        success=outcome.success,
        steps=outcome.steps,
        reason=outcome.reason,
        prompt=prompt,
        video=video,
        poster=poster,
    )


def command_of(config: EvaluationConfig) -> str:
    """The command that repeats an evaluation."""
    words = [
        "openvima evaluate",
        f"--policy {shlex.quote(','.join(config.policies))}",
        f"--tasks {','.join(config.tasks)}",
        f"--levels {','.join(config.levels)}",
        f"--episodes {config.episodes}",
        f"--seed {config.seed}",
        *config.setup.words(),
        *([] if config.batch == DEFAULT_BATCH else [f"--batch {config.batch}"]),
        "--out DIR",
    ]
    return " ".join(words)


def find_metrics(sources: Sequence[PolicySource]) -> Path | None:
    """The training record of the first trained policy that has one."""
    for source in sources:
        folder = Path(source.source)
        for candidate in (folder / _METRICS, folder.parent / _METRICS, folder.parent.parent / _METRICS):
            if source.kind == "run" and candidate.is_file():
                return candidate
    return None


def _seeds_to_film(row: Row, number: int, *, unsolved: bool) -> list[int]:
    solved = [outcome.seed for outcome in row.outcomes if outcome.success][:number]
    failed = [outcome.seed for outcome in row.outcomes if not outcome.success][:number] if unsolved else []
    return solved + failed


def _single(row: Row, source: PolicySource, seed: int, config: EvaluationConfig) -> Batch:
    return Batch(row.policy, source.source, row.task, row.level, seed, 1, config.setup)
