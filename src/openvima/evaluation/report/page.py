"""The report as one HTML file that needs nothing else: no network, no scripts, no other files."""

from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from openvima.evaluation.clips import Clip
from openvima.evaluation.report import sections
from openvima.evaluation.report.curves import read_charts
from openvima.evaluation.report.wording import headline, prose
from openvima.evaluation.results import Results
from openvima.files import write_whole


def write_report(
    results: Results,
    out: Path,
    *,
    command: str = "",
    metrics: Path | None = None,
    clips: Sequence[Clip] = (),
) -> Path:
    """Write the report of an evaluation.

    Args:
        results: What was found.
        out: The HTML file to write.
        command: The command that repeats the evaluation; by default put together from `results.config`.
        metrics: `metrics.jsonl` of the training run, for its curves.
        clips: Filmed episodes.

    Returns:
        The file.

    Raises:
        MissingExtraError: matplotlib is not installed.
        DatasetError: `metrics` is damaged.
    """
    body = (
        sections.policy_cards(results),
        sections.rate_table(results),
        sections.clip_cards(clips),
        sections.level_charts(results),
        sections.training_charts(read_charts(metrics) if metrics else []),
        sections.failure_table(results),
        sections.level_meanings(results),
        sections.reproduction(results, command or default_command(results)),
    )
    return write_whole(out, _page(results, "\n".join(part for part in body if part)))


def default_command(results: Results) -> str:
    """Put the command together from the settings; run folders appear under their names only."""
    config = results.config
    policies = [
        f"{name}=RUN" if results.policies.get(name, {}).get("kind") == "run" else name
        for name in results.policy_names()
    ]
    return (
        f"openvima evaluate --policy {','.join(policies)} --tasks {','.join(config.get('tasks', ['all']))} "
        f"--levels {','.join(config.get('levels', results.levels()))} --episodes {config.get('episodes', 0)} "
        f"--seed {config.get('seed', 0)} --out DIR"
    )


def _page(results: Results, body: str) -> str:
    style = resources.files("openvima.evaluation.report").joinpath("style.css").read_text(encoding="utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta name="description" content="{sections.summary_line(results)}">\n'
        f"<title>{prose(headline(results))} · openvima</title>\n"
        '<link rel="icon" href="data:,">\n'
        f"<style>\n{style}</style>\n</head>\n<body>\n{sections.heading(results)}\n<main>\n{body}\n</main>\n"
        f"<footer><div>openvima {prose(results.versions.get('openvima', ''))} · prompts, images and films "
        "on this page come from the evaluated episodes themselves.</div></footer>\n</body>\n</html>\n"
    )
