"""The report: one self-contained HTML file, readable without its script."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from openvima.atomic_io import atomic_write_file
from openvima.evaluation.comparison import Comparison, compare_pairs, default_pairs
from openvima.evaluation.config import DEFAULT_BATCH
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.sources import NAMED_POLICIES
from openvima.html import render_page
from openvima.input_files import as_path, names_of
from openvima.policies.naming import UNTRAINED, VLM
from openvima.report import figures, published, tables, text
from openvima.report.curves import read_run_charts
from openvima.report.text import Confirmation
from openvima.video.encoder import Clip

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
        runs: Folders of training runs, or their `metrics.jsonl`, for their curves.
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
    records = [as_path(run) for run in names_of(runs)]
    clips = list({clip.file_name: clip for clip in clips}.values())
    videos = video_ids(clips)
    listed, num_episodes = listed_episodes(results, videos)
    page = render_page(
        "report",
        text=text,
        tables=tables,
        figures=figures,
        published=published,
        published_column=with_published
        and any(published.published_tasks(row.level).get(row.task) for row in results.rows),
        results=results,
        means=results.means(),
        colours=text.series_colours(results),
        notes=notes,
        clips=clips,
        videos=videos,
        episodes=listed,
        num_episodes=num_episodes,
        comparisons=comparisons,
        confirmations=confirmations,
        all_confirmed=bool(confirmations) and all(each.confirmed for each in confirmations),
        ablations=tables.ablations_by_policy(results),
        families=tables.family_table(results, published=with_published),
        published_tasks=published.published_task_table(results) if with_published else None,
        published_results=published.published_rows(results, published.published_models())
        if with_published
        else [],
        training_charts=read_run_charts(records),
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


def video_ids(clips: Sequence[Clip]) -> dict[tuple[str, str, str, int], str]:
    """Name each video of the page, by policy, task, level and seed."""
    return {(c.policy, c.task, c.level, c.seed): f"video-{number}" for number, c in enumerate(clips, 1)}


def listed_episodes(
    results: Results, videos: Mapping[tuple[str, str, str, int], str]
) -> tuple[list[tuple[Row, EpisodeOutcome, str]], int]:
    """List the episodes without input ablations, failures first.

    Args:
        results: The evaluation.
        videos: Ids of the videos on the page.

    Returns:
        At most `MOST_EPISODES` episodes, each with its row and the id of its video, or an empty one; and how
        many there are.
    """
    episodes = [
        (row, outcome, videos.get((row.policy, row.task, row.level, outcome.seed), ""))
        for row in results.rows
        if not row.ablation
        for outcome in row.outcomes
    ]
    ranked = sorted(episodes, key=lambda episode: episode[1].success)
    if len(ranked) > MOST_EPISODES:
        ranked = [episode for episode in ranked if not episode[1].success][:MOST_EPISODES]
    return ranked, len(episodes)
