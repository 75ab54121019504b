"""The report: one self-contained HTML file, readable without its script."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from openvima.atomic_io import atomic_write_file
from openvima.evaluation.comparison import Comparison, compare_pairs, default_pairs
from openvima.evaluation.config import DEFAULT_BATCH
from openvima.evaluation.results import DECLARED, Results
from openvima.evaluation.sources import NAMED_POLICIES
from openvima.html import render_page
from openvima.input_files import as_path, names_of
from openvima.policies.naming import UNTRAINED, VLM
from openvima.report import figures, published, tables, text
from openvima.report.curves import read_run_charts
from openvima.video.encoder import Clip

_OPTIONS = (  # settings that results name as commands do
    "tasks",
    "levels",
    "episodes",
    "seed",
    "batch",
    "assets",
    "compat",
    "prompts",
    "task_options",
    "control",
    "ablations",
    "boxes",
    "device",
    "precision",
)
MOST_EPISODES = 4000  # that are listed
_USUAL = {"assets": "procedural", "batch": DEFAULT_BATCH, "compat": False}
_PLACES = {"run": "RUN", "remote": "ws://HOST:PORT"}
_VLM_OPTIONS = {"view": "view"} | {
    name: f"vlm.{name.replace('_', '-')}"
    for name in ("points", "enlarge", "boxes", "shots", "temperature", "free_text")
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
    confirmations: Mapping[str, bool] = MappingProxyType({}),
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
        confirmations: For the folder of each evaluation whether its outcomes were confirmed by replay.

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
    episodes = [(row, outcome) for row in results.rows if not row.ablation for outcome in row.outcomes]
    episodes.sort(key=lambda episode: episode[1].success)  # failures first
    page = render_page(
        "report",
        text=text,
        tables=tables,
        figures=figures,
        published=published,
        published_column=with_published and published.has_published_tasks(results),
        results=results,
        means=results.means(),
        colours=text.series_colours(results),
        notes=notes,
        clips=clips,
        videos={(clip.policy, clip.task, clip.level, clip.seed) for clip in clips},
        episodes=episodes[:MOST_EPISODES],
        num_episodes=len(episodes),
        comparisons=comparisons,
        confirmations={shlex.quote(folder): done for folder, done in confirmations.items()},
        all_confirmed=bool(confirmations) and all(confirmations.values()),
        declared=DECLARED,
        ablations=tables.ablations_by_policy(results),
        families=tables.family_table(results, published=with_published),
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
    vlm = next((what for what in results.policies.values() if what.get("kind") == "vlm"), None)
    words = [
        f"openvima evaluate --policy {shlex.quote(','.join(policies))}",
        *[
            _option(name.replace("_", "-"), config[name])
            for name in _OPTIONS
            if name in config and config[name] != _USUAL.get(name)
        ],
        *(["--trust-code"] if any("code" in what for what in results.policies.values()) else []),
        *([] if vlm is None else ["--base-url URL"]),  # the address of its server is not in results
        *[_option(option, vlm[name]) for name, option in _VLM_OPTIONS.items() if vlm and vlm.get(name)],
        "--out DIR",
    ]
    return " ".join(words)


def _option(name: str, value: Any) -> str:
    text = ",".join(map(str, value)) if isinstance(value, list) else str(value)
    return f"--{name}" if value is True else f"--{name} {shlex.quote(text)}"


def _policy_word(name: str, what: Mapping[str, Any]) -> str:
    """Name a policy for `--policy`, with a placeholder for the path of its weights."""
    kind = what.get("kind")
    preset = what.get("preset")
    if kind == "vlm":
        return f"{name}={VLM}{what.get('model', 'MODEL')}"
    named = f"{UNTRAINED}:{preset}" if preset else what.get("bundled") or what.get("source")
    source = named or (kind if kind in NAMED_POLICIES else _PLACES.get(str(kind), name))
    return name if name == source else f"{name}={source}"
