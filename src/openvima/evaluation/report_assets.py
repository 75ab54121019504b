"""What follows an evaluation's results: films of a few episodes, and the report."""

import importlib.util
import re
import shlex
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from openvima.errors import ConfigError, MissingExtraError
from openvima.evaluation.clips import Clip, load_clips, png, save_clips
from openvima.evaluation.config import (
    DEFAULT_BATCH,
    DEFAULT_DEVICE,
    Batch,
    EvaluationConfig,
    cells,
)
from openvima.evaluation.results import Results, Row
from openvima.evaluation.sources import PolicySource
from openvima.multiprocess import in_processes
from openvima.policies.bundled import PACKAGED

REPORT_NAME = "report.html"
_METRICS = "metrics.jsonl"  # what a training run writes into its folder
_EPISODE = re.compile(r"(\w+)/(?:(\w+)/)?(\d+)")


@dataclass(frozen=True, slots=True)
class RecordingJob:
    """One episode to film: a batch of one, under the name that its policy bears in the results."""

    batch: Batch
    fingerprint: str

    @property
    def episode(self) -> tuple[str, str, str, int]:
        """Policy, task, level and seed."""
        return self.batch.policy, self.batch.task, self.batch.level, self.batch.first_seed


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

    jobs = recording_jobs(config, results)
    clips = _filmed(jobs, config, note)
    return write_report(
        results,
        config.out / REPORT_NAME,
        command=command_of(config),
        metrics=find_metrics(config.sources),
        clips=clips,
    )


def _filmed(
    jobs: Sequence[RecordingJob], config: EvaluationConfig, note: Callable[[str], None] | None
) -> list[Clip]:
    """Film the episodes that were not filmed before."""
    clips = {(clip.policy, clip.task, clip.level, clip.seed): clip for clip in load_clips(config.out)}
    missing = [job for job in jobs if job.episode not in clips]
    for number, (job, clip) in enumerate(in_processes(film, missing, config.workers or 1), 1):
        clips[job.episode] = clip
        if note is not None:
            note(f"filmed {number} of {len(missing)}")
    wanted = [clips.pop(job.episode) for job in jobs]
    found = [*wanted, *clips.values()]  # those of an earlier command stay
    if missing:
        save_clips(found, config.out)
    return found


def requested_episodes(config: EvaluationConfig) -> list[tuple[str, str, int]]:
    """Read the episodes that `config.film` names: task, level, seed.

    Raises:
        ConfigError: A name cannot be read, or the episode is not played.
    """
    played = cells(config)
    chosen = []
    for text in config.film:
        found = _EPISODE.fullmatch(text)
        if found is None:
            raise ConfigError(f"film is {text!r}; give TASK/SEED or TASK/LEVEL/SEED, such as rotate/L1/3.")
        task, wanted, seed = found[1], found[2], int(found[3])
        level = next((level for name, level in played if name == task and wanted in (None, level)), None)
        last = config.seed + config.episodes - 1
        if level is None or not config.seed <= seed <= last:
            raise ConfigError(
                f"film is {text!r}, which is not played; tasks and levels are those of this evaluation, and "
                f"seeds {config.seed} to {last}."
            )
        chosen.append((task, level, seed))
    return chosen


def recording_jobs(config: EvaluationConfig, results: Results) -> list[RecordingJob]:
    """Choose which episodes to film, without looking at them.

    Of each task at the first level that holds it: the first `config.videos` solved episodes of every trained
    policy and of the oracle, and as many unsolved ones of trained policies. Where there are neither trained
    policies nor the oracle, of all policies. And the episodes that were chosen by hand, of every policy.
    """
    sources, by_hand = config.sources, requested_episodes(config)
    worth = [source for source in sources if source.kind in ("run", "remote", "oracle")] or sources
    jobs = []
    for source in worth:
        for task in results.tasks():
            levels = (results.row(source.name, task, level) for level in results.levels())
            row = next((row for row in levels if row is not None), None)
            if row is not None:
                seeds = _seeds_to_film(row, config.videos, unsolved=source.kind != "oracle")
                jobs += [_job(config, results, source, row, seed) for seed in seeds]
    for source in sources:
        for task, level, seed in by_hand:
            row = results.row(source.name, task, level)
            if row is not None:
                jobs.append(_job(config, results, source, row, seed))
    return list(dict.fromkeys(jobs))


def film(job: RecordingJob, count: Callable[[int], None]) -> Clip:
    """Film one episode; runs in a worker process."""
    from PIL import Image

    from openvima.evaluation.film import SceneRenderer, record_episode
    from openvima.evaluation.prompt_strip import thumbnail
    from openvima.evaluation.rollout_policies import load_rollout_policy, one_thread

    batch = job.batch
    env = batch.setup.make(batch.task, batch.level, domain="eval", realtime=True)
    env.reset(seed=batch.first_seed)
    poster = png(Image.fromarray(SceneRenderer(env, enlarge=2).draw(env.scene)))
    prompt = tuple(part if isinstance(part, str) else png(thumbnail(part)) for part in env.prompt.sequence())
    with tempfile.TemporaryDirectory() as folder, one_thread(batch):
        path = Path(folder, "film.mp4")
        player = load_rollout_policy(batch, job.fingerprint)
        outcome = record_episode(env, player, batch.first_seed, path, with_prompt=False)
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
        *([f"--ablations {','.join(config.ablations)}"] if config.ablations else []),
        *([f"--boxes {shlex.quote(config.boxes)}"] if config.boxes else []),
        *([] if config.device == DEFAULT_DEVICE else [f"--device {config.device}"]),
        *([f"--precision {config.precision}"] if config.precision else []),
        "--out DIR",
    ]
    return " ".join(words)


def find_metrics(sources: Sequence[PolicySource]) -> Path | None:
    """The training record of the first trained policy that has one."""
    for source in sources:
        if source.source in PACKAGED:  # a name and no place: what lies here is of something else
            continue
        folder = Path(source.source)
        for candidate in (folder / _METRICS, folder.parent / _METRICS, folder.parent.parent / _METRICS):
            if source.kind == "run" and candidate.is_file():
                return candidate
    return None


def _seeds_to_film(row: Row, number: int, *, unsolved: bool) -> list[int]:
    solved = [outcome.seed for outcome in row.outcomes if outcome.success][:number]
    failed = [outcome.seed for outcome in row.outcomes if not outcome.success][:number] if unsolved else []
    return solved + failed


def _job(
    config: EvaluationConfig, results: Results, source: PolicySource, row: Row, seed: int
) -> RecordingJob:
    batch = Batch(
        row.policy,
        source.source,
        row.task,
        row.level,
        seed,
        1,
        config.setup,
        device=config.device,
        precision=config.precision or "",
    )
    return RecordingJob(batch, str(results.policies.get(source.name)))
