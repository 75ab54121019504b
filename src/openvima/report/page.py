"""The report: one self-contained HTML file without scripts."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from openvima.atomic_io import atomic_write_file
from openvima.evaluation.comparison import Comparison, compare_pairs, default_pairs
from openvima.evaluation.results import Results
from openvima.evaluation.sources import NAMED_POLICIES
from openvima.html import render_page
from openvima.report import sections
from openvima.report.ablations import ablation_section
from openvima.report.curves import read_run_charts
from openvima.report.differences import comparison_section
from openvima.report.published_comparison import published_section
from openvima.report.tables import failure_table, rate_table
from openvima.report.text import findings, headline
from openvima.video.clips import Clip

_OPTIONS = {  # settings that a command names where they are not these
    "assets": "procedural",
    "difficulty": "easy",
    "batch": 16,
    "boxes": "",
    "device": "cpu",
    "precision": "",
}
_PLACES = {"run": "RUN", "remote": "ws://HOST:PORT"}


def write_report(
    results: Results,
    out: Path,
    *,
    command: str = "",
    metrics: Path | None = None,
    runs: Sequence[Path] = (),
    clips: Sequence[Clip] = (),
    comparisons: Sequence[Comparison] | None = None,
    notes: Sequence[str] = (),
) -> Path:
    """Write the report of an evaluation.

    Args:
        results: What was found.
        out: The HTML file to write.
        command: The command that repeats the evaluation; by default put together from `results.config`.
        metrics: `metrics.jsonl` of the training run, for its curves.
        runs: Folders of training runs, for theirs.
        clips: Recorded episodes.
        comparisons: Policies to compare; by default those of `comparison.default_pairs`.
        notes: Warnings to put at the top.

    Returns:
        The file.

    Raises:
        MissingExtraError: matplotlib is not installed.
        DatasetError: The record of a training run is missing or damaged.
    """
    if comparisons is None:
        comparisons = compare_pairs(results, default_pairs(results))
    records = [*([metrics] if metrics else []), *runs]
    body = (
        sections.policy_cards(results),
        rate_table(results),
        sections.clip_cards(clips),
        failure_table(results),
        sections.level_charts(results),
        comparison_section(comparisons),
        ablation_section(results),
        published_section(results),
        sections.training_charts(read_run_charts(records) if records else []),
        sections.level_meanings(results),
        sections.reproduction(results, command or default_command(results)),
    )
    page = render_page(
        "report",
        headline=headline(results),
        summary=findings(results),
        measured=sections.measured(results),
        notes=notes,
        sections=[part for part in body if part],
        version=results.versions.get("openvima", ""),
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
        f"--tasks {','.join(config.get('tasks', ['all']))}",
        f"--levels {','.join(config.get('levels', results.levels()))} --episodes {config.get('episodes', 0)}",
        f"--seed {config.get('seed', 0)}",
        *[
            f"--{name} {shlex.quote(str(config[name]))}"
            for name, usual in _OPTIONS.items()
            if config.get(name, usual) != usual
        ],
        *(["--compat"] if config.get("compat") else []),
        *([f"--ablations {','.join(config['ablations'])}"] if config.get("ablations") else []),
        "--out DIR",
    ]
    return " ".join(words)


def _policy_word(name: str, what: Mapping[str, Any]) -> str:  # Any: plain values
    """Name a policy for `--policy`, with a placeholder for the path of its weights."""
    kind = what.get("kind")
    named = what.get("preset") or what.get("bundled")
    source = named or (kind if kind in NAMED_POLICIES else _PLACES.get(str(kind), name))
    return name if name == source else f"{name}={source}"
