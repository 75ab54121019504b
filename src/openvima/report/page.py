"""The report: one self-contained HTML file, readable without its script."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from openvima.atomic_io import atomic_write_file
from openvima.evaluation.comparison import Comparison, compare_pairs, default_pairs
from openvima.evaluation.config import DEFAULT_BATCH
from openvima.evaluation.results import EpisodeOutcome, Results
from openvima.evaluation.sources import NAMED_POLICIES
from openvima.html import render_page
from openvima.input_files import as_path, names_of
from openvima.policies.naming import UNTRAINED, VLM
from openvima.report import figures, published, tables, text
from openvima.report.ablations import ablated_policies, rate_figures
from openvima.report.curves import read_run_charts
from openvima.report.published import published_task_table
from openvima.report.tables import family_table, level_drop_table, level_figure
from openvima.report.text import Confirmation, plain_reason
from openvima.video.encoder import Clip

_FUNCTIONS = (  # that the templates in `html/templates/report/` call
    *(text.percent, text.exact, text.points, text.points_span, text.probability, text.span, text.counted),
    *(text.answers, text.listed, text.role, text.finding, text.ablation_name, text.ablation_descriptions),
    *(tables.oracle_horizon_means, tables.failure_causes, figures.level_chart, figures.curve_chart),
    *(published.published_rate, published.published_coverage, published.published_rows),
    *(published.leading_models, figures.rate_figure_html, figures.table_html, text.plain_reason),
)
_OPTIONS = {  # settings that a command names where they are not these
    "assets": "procedural",
    "prompts": "multimodal",
    "task_options": "",
    "control": "primitives",
    "batch": DEFAULT_BATCH,
    "boxes": "",
    "device": "cpu",
    "precision": "",
}
_PLACES = {"run": "RUN", "remote": "ws://HOST:PORT"}
_VLM_OPTIONS = {"view": "view"} | {
    name: f"vlm.{name}" for name in ("points", "enlarge", "boxes", "shots", "temperature")
}


def write_report(
    results: Results,
    out: str | Path,
    *,
    command: str = "",
    metrics: str | Path | None = None,
    runs: str | Path | Sequence[str | Path] = (),
    clips: Sequence[Clip] = (),
    comparisons: Sequence[Comparison] | None = None,
    notes: Sequence[str] = (),
    with_published: bool = True,
    confirmations: Sequence[Confirmation] = (),
) -> Path:
    """Write the report of an evaluation.

    Args:
        results: What was found.
        out: The HTML file to write.
        command: The command that repeats the evaluation; by default composed from `results.config`.
        metrics: `metrics.jsonl` of the training run, for its curves.
        runs: Folders of training runs, for theirs.
        clips: Recorded episodes.
        comparisons: Policies to compare; by default those of `comparison.default_pairs`.
        notes: Warnings to put at the top.
        with_published: Whether to show published numbers of the same tasks, unless prompts or tasks differ.
        confirmations: For each evaluation whether its outcomes were confirmed by replay.

    Returns:
        The file.

    Raises:
        MissingExtraError: matplotlib is not installed.
        DatasetError: The record of a training run is missing or damaged.
    """
    if comparisons is None:
        comparisons = compare_pairs(results, default_pairs(results))
    with_published = with_published and published.is_comparable(results)
    out = as_path(out)
    records = [*map(as_path, [*([metrics] if metrics else []), *names_of(runs)])]
    clips = list({clip.file_name: clip for clip in clips}.values())
    videos = video_ids(clips)
    listed, num_episodes = listed_episodes(results, videos)
    page = render_page(
        "report",
        **{function.__name__: function for function in _FUNCTIONS},
        disagreements=disagreements,
        level_names=text.LEVEL_NAMES,
        level_meanings=text.LEVEL_MEANINGS,
        published_column=with_published
        and any(published.published_tasks(row.level).get(row.task) for row in results.rows),
        published_model=" ".join(published.BESIDE),
        reliability=published.RELIABILITY,
        by_task=published.BY_TASK,
        results=results,
        means=results.means(),
        colours=text.series_colours(results),
        headline=text.headline(results),
        summary=text.findings(results),
        measured=text.measured(results),
        notes=notes,
        clips=clips,
        videos=videos,
        episodes=listed,
        num_episodes=num_episodes,
        comparisons=comparisons,
        confirmations=confirmations,
        all_confirmed=bool(confirmations) and all(each.confirmed for each in confirmations),
        ablations=ablated_policies(results),
        rate_figures=rate_figures(results),
        families=family_table(results, published=with_published),
        level_figure=level_figure(results, published=with_published),
        level_drop=level_drop_table(results, published=with_published),
        published_tasks=published_task_table(results) if with_published else None,
        published_results=published.published_rows(results, published.published_models())
        if with_published
        else [],
        training_charts=read_run_charts(records) if records else [],
        command=command or default_command(results),
    )
    return atomic_write_file(out, page)


def default_command(results: Results, policies: Sequence[str] = ()) -> str:
    """Compose the command that reproduces an evaluation from its settings.

    Args:
        results: The evaluation.
        policies: Its policies as given; by default their names, with placeholders for paths and addresses.
    """
    config = results.config
    policies = policies or [
        _policy_word(name, results.policies.get(name, {})) for name in results.policy_names()
    ]
    words = [
        f"openvima evaluate --policy {shlex.quote(','.join(policies))}",
        f"--tasks {shlex.quote(','.join(config.get('tasks', ['all'])))}",
        f"--levels {shlex.quote(','.join(config.get('levels', results.levels())))}",
        *[f"--{name} {shlex.quote(str(config.get(name, 0)))}" for name in ("episodes", "seed")],
        *[
            f"--{name.replace('_', '-')} {shlex.quote(str(config[name]))}"
            for name, usual in _OPTIONS.items()
            if config.get(name, usual) != usual
        ],
        *(["--compat"] if config.get("compat") else []),
        *(["--trust-code"] if any("code" in what for what in results.policies.values()) else []),
        *([f"--ablations {shlex.quote(','.join(config['ablations']))}"] if config.get("ablations") else []),
        *[word for what in list(filter(_is_vlm, results.policies.values()))[:1] for word in _vlm_words(what)],
        "--out DIR",
    ]
    return " ".join(words)


def _is_vlm(what: Mapping[str, Any]) -> bool:
    return what.get("kind") == "vlm"


def _vlm_words(what: Mapping[str, Any]) -> list[str]:
    """Name the settings of a vision-language model; the address of its server is not in results."""
    words = [
        f"--{option} {shlex.quote(str(what[name]))}"
        for name, option in _VLM_OPTIONS.items()
        if what.get(name)
    ]
    return ["--base-url URL", *words, *(["--vlm.free-text"] if what.get("free_text") else [])]


def _policy_word(name: str, what: Mapping[str, Any]) -> str:
    """Name a policy for `--policy`, with a placeholder for the path of its weights."""
    kind = what.get("kind")
    preset = what.get("preset")
    if _is_vlm(what):
        return f"{name}={VLM}{what.get('model', 'MODEL')}"
    named = f"{UNTRAINED}:{preset}" if preset else what.get("bundled") or what.get("source")
    source = named or (kind if kind in NAMED_POLICIES else _PLACES.get(str(kind), name))
    return name if name == source else f"{name}={source}"


MOST_EPISODES = 4000  # that are listed; of more, failures alone


class ListedEpisode(NamedTuple):
    """One episode, how it ended, and the id of its video on the page; that is empty without one."""

    policy: str
    level: str
    task: str
    outcome: EpisodeOutcome
    video: str

    @property
    def reason(self) -> str:
        """Why it failed, in plain English; empty on success."""
        return plain_reason(self.outcome.reason)

    @property
    def cause(self) -> str:
        """The same without the names of objects, for a menu."""
        return plain_reason(self.outcome.kind)


class Disagreement(NamedTuple):
    """Seeds of a task and level that only one of two policies solved."""

    task: str
    level: str
    only_a: tuple[int, ...]
    only_b: tuple[int, ...]


def video_ids(clips: Sequence[Clip]) -> dict[tuple[str, str, str, int], str]:
    """Name each video of the page, by policy, task, level and seed."""
    return {(c.policy, c.task, c.level, c.seed): f"video-{number}" for number, c in enumerate(clips, 1)}


def listed_episodes(
    results: Results, videos: Mapping[tuple[str, str, str, int], str]
) -> tuple[list[ListedEpisode], int]:
    """List the episodes without input ablations, failures first.

    Args:
        results: The evaluation.
        videos: Ids of the videos on the page.

    Returns:
        At most `MOST_EPISODES` episodes, and how many there are.
    """
    episodes = [
        ListedEpisode(r.policy, r.level, r.task, o, videos.get((r.policy, r.task, r.level, o.seed), ""))
        for r in results.rows
        if not r.ablation
        for o in r.outcomes
    ]
    ranked = sorted(episodes, key=lambda episode: episode.outcome.success)
    if len(ranked) > MOST_EPISODES:
        ranked = [episode for episode in ranked if not episode.outcome.success][:MOST_EPISODES]
    return ranked, len(episodes)


def disagreements(results: Results, comparison: Comparison) -> list[Disagreement]:
    """List the episodes that only one of two policies solved; none for scores under an input ablation."""
    found = []
    for difference in comparison.tasks:
        rows = [results.row(name, difference.task, difference.level) for name in (comparison.a, comparison.b)]
        solved = [{o.seed: o.success for o in row.outcomes} for row in rows if row is not None]
        if len(solved) == 2 and (difference.only_a or difference.only_b):
            a, b = solved
            only_a = tuple(seed for seed in a if a[seed] and b.get(seed) is False)
            only_b = tuple(seed for seed in b if b[seed] and a.get(seed) is False)
            found.append(Disagreement(difference.task, difference.level, only_a, only_b))
    return found
