"""Report assets: an evaluation followed by videos of some of its episodes and by the report."""

import importlib.util
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

from openvima.atomic_io import folder_lock
from openvima.errors import ConfigError, MissingExtraError
from openvima.evaluation.config import Batch, EvaluationConfig, cells
from openvima.evaluation.results import Results
from openvima.evaluation.runner import evaluate
from openvima.evaluation.sources import TRAINED_KINDS, PolicySource
from openvima.evaluation.verification import is_marked_verified
from openvima.multiprocess import Report, imap_unordered
from openvima.policies.naming import BUNDLED, METRICS_FILE, ORACLE, PolicyRef
from openvima.report.page import default_command, write_report
from openvima.video.encoder import Clip, load_clips, png, save_clips

REPORT_NAME = "report.html"
MOST_VIDEOS = 40  # for each of `per_task`; one takes about a second
_EPISODE = re.compile(r"(\w+)/(?:(\w+)/)?(\d+)")


@dataclass(frozen=True, slots=True)
class VideoSelection:
    """Which episodes to record for the report.

    Args:
        per_task: Solved episodes, and failures, of each trained policy, task and level; failures first, and
            at most `MOST_VIDEOS` times as many in all.
        record_video: Further episodes, of every policy: "task/seed" at the task's first level, or
            "task/level/seed".

    Raises:
        ConfigError: `per_task` is negative.
    """

    per_task: int = 1
    record_video: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.per_task < 0:
            raise ConfigError(f"videos is {self.per_task}; it must be at least 0.")


DEFAULT_VIDEOS = VideoSelection()


def require_extra() -> None:
    """Check that the packages of the extra `report` are installed.

    Raises:
        MissingExtraError: One is not.
    """
    missing = [name for name in ("matplotlib", "av", "jinja2") if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingExtraError(
            f"the report needs {' and '.join(missing)}; install with: pip install 'openvima[report]', "
            "or evaluate with --no-report."
        )


def evaluate_and_report(
    config: EvaluationConfig, videos: VideoSelection = DEFAULT_VIDEOS, progress: Report | None = None
) -> Path:
    """Evaluate policies, record some of the episodes and write `report.html`: `openvima evaluate`.

    Args:
        config: What to evaluate.
        videos: Which episodes to record.
        progress: As for `evaluate`.

    Returns:
        `results.json`; `report.html` and the folder `videos` are beside it.

    Raises:
        ConfigError: An episode to record is not part of the evaluation, or as for `evaluate`.
        MissingExtraError: matplotlib, PyAV or Jinja is not installed, or as for `evaluate`.
    """
    check_report(config, videos)
    with config.served() as served:
        path = evaluate(served, progress)
        report_on(served, videos, progress, policies=config.policies)
    return path


def check_report(config: EvaluationConfig, videos: VideoSelection) -> None:
    """Check before an evaluation that its report can be written; raises as `evaluate_and_report` does."""
    require_extra()
    requested_episodes(config, videos)


def report_on(
    config: EvaluationConfig,
    videos: VideoSelection,
    progress: Report | None = None,
    *,
    policies: Sequence[str] = (),
) -> None:
    """Record some of the episodes of a finished evaluation and write its `report.html`.

    Args:
        config: The evaluation.
        videos: Which episodes to record.
        progress: Called with episodes of the evaluation, twice, and a note on the videos.
        policies: Policies as given, for the command in the report; as for `default_command`.
    """
    with folder_lock(config.out):
        results = Results.read(config.out)
        episodes = sum(row.episodes for row in results.rows)
        note = None if progress is None else lambda text: progress(episodes, episodes, text)
        write_report(
            results,
            config.out / REPORT_NAME,
            command=default_command(results, policies),
            runs=find_metrics(config.sources),
            clips=_recorded(recordings(config, videos, results), config, note),
            confirmations={"DIR": is_marked_verified(config.out)},
        )


def _recorded(
    batches: Sequence[Batch], config: EvaluationConfig, note: Callable[[str], None] | None
) -> list[Clip]:
    """Record the episodes that were not recorded before."""
    clips = {(clip.policy, clip.task, clip.level, clip.seed): clip for clip in load_clips(config.out)}
    missing = [batch for batch in batches if batch.episode not in clips]
    for number, (batch, clip) in enumerate(imap_unordered(record_clip, missing, config.workers or 1), 1):
        clips[batch.episode] = clip
        if note is not None:
            note(f"recorded {number} of {len(missing)} (--videos 0: none)")
    requested = [clips.pop(batch.episode) for batch in batches]
    found = [*requested, *clips.values()]  # those of an earlier command stay
    if missing:
        save_clips(found, config.out)
    return found


def requested_episodes(config: EvaluationConfig, videos: VideoSelection) -> list[tuple[str, str, int]]:
    """Parse `videos.record_video` into task, level and seed.

    Raises:
        ConfigError: A name cannot be parsed, or the episode is not part of the evaluation.
    """
    played = cells(config)
    requested = []
    for text in videos.record_video:
        task, wanted, seed = found.groups() if (found := _EPISODE.fullmatch(text)) else ("", "", -1)
        level = next((level for name, level in played if name == task and wanted in (None, level)), None)
        last = config.seed + config.episodes - 1
        if level is None or not config.seed <= int(seed) <= last:
            raise ConfigError(
                f"record_video is {text!r}; give TASK/SEED or TASK/LEVEL/SEED, such as rotate/L1/3, of this "
                f"evaluation, with seeds {config.seed} to {last}."
            )
        requested.append((task, level, int(seed)))
    return requested


def recordings(config: EvaluationConfig, videos: VideoSelection, results: Results) -> list[Batch]:
    """Choose which episodes to record, each as a batch of one.

    Of each task and level: the first `videos.per_task` solved episodes and failures of every trained policy.
    Of the oracle the first solved ones of each task. Without trained policies and oracle, of all policies.
    Failures come first, and the budget ends the list. Then the requested episodes, of
    every policy.
    """
    sources, requested = config.sources, requested_episodes(config, videos)
    shown = [source for source in sources if source.kind in (*TRAINED_KINDS, ORACLE)] or list(sources)
    chosen: list[tuple[PolicySource, str, str, int]] = []
    for success in (False, True):
        for task in results.tasks():
            levels = [level for level in results.levels() if task in results.tasks(level)]
            for level, source in product(levels, shown):
                row = results.row(source.name, task, level)
                if row is None or (source.kind == ORACLE and not (success and level == levels[0])):
                    continue
                seeds = [outcome.seed for outcome in row.outcomes if outcome.success == success]
                chosen += [(source, task, level, seed) for seed in seeds[: videos.per_task]]
    chosen = chosen[: MOST_VIDEOS * videos.per_task]
    chosen += [(source, *e) for source in sources for e in requested if results.row(source.name, *e[:2])]
    return [
        replace(
            config.batch_of(source, "", task, level, seed, 1),
            fingerprint=str(results.policies.get(source.name)),
        )
        for source, task, level, seed in dict.fromkeys(chosen)
    ]


def record_clip(batch: Batch, count: Callable[[int], None]) -> Clip:
    """Record one episode; runs in a worker process."""
    from PIL import Image

    from openvima.evaluation.recording import record_episode
    from openvima.evaluation.rollout_policies import load_rollout_policy, one_thread
    from openvima.video.prompt_strip import thumbnail
    from openvima.video.recorder import SceneRenderer

    env = batch.make_env(realtime=True)
    env.reset(seed=batch.first_seed)
    poster = png(Image.fromarray(SceneRenderer(env, enlarge=2).draw(env.scene)))
    prompt = tuple(part if isinstance(part, str) else png(thumbnail(part)) for part in env.prompt.sequence())
    with tempfile.TemporaryDirectory() as folder, one_thread(batch):
        path = Path(folder, "video.mp4")
        policy = load_rollout_policy(batch)
        speaks = PolicyRef.parse(batch.source).kind == "vlm"  # then its words are beside the table
        outcome = record_episode(
            env, policy, batch.first_seed, path, with_prompt=False, explain=speaks, may_fail=True
        )
        video = path.read_bytes()
    count(1)
    ended = (outcome.success, outcome.steps, outcome.reason)
    return Clip(*batch.episode, *ended, prompt=prompt, video=video, poster=poster)


def find_metrics(sources: Sequence[PolicySource]) -> list[Path]:
    """Return the training record of the first trained policy that has one."""
    folders = [
        Path(source.source) for source in sources if source.kind == "run" and source.source not in BUNDLED
    ]
    places = [place for folder in folders for place in (folder, folder.parent, folder.parent.parent)]
    return [place / METRICS_FILE for place in places if (place / METRICS_FILE).is_file()][:1]
