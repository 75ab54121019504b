"""Publish openvima-small: weights into the package; record, tables and figures from its evaluations.

    python experiments/openvima_small/publish.py --run RUN --data DATA
    PYTHONPATH=benchmarks python experiments/openvima_small/publish.py SCORES

The first copies the best checkpoint of a training, its settings, metrics and logs, and the list of its
training data into the package. The second reads the folders of SCORES, which the names in `findings.py` say
(`default`, `simulator`, `previous`, …), and writes OUT.json, figures, and the tables between
`<!-- small:NAME -->` and `<!-- /small:NAME -->` in each file of `--fill` and in OUT.md. What is absent leaves
its tables out, with a line on stderr; but a record that is there already keeps what SCORES does not have: its
evaluations, which belong together, or its ablations or baselines.
"""

import argparse
import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from failures import draw_failures
from figures import save_all
from findings import POLICY, Findings, Training, find, level_means
from openvima.atomic_io import atomic_write_file
from openvima.errors import ConfigError, OpenVimaError
from openvima.evaluation.actions import ACTIONS_NAME
from openvima.evaluation.results import LevelMean, Results, Row
from openvima.evaluation.sources import weights_hash
from openvima.policies.naming import BUNDLED, MODEL_CARD, SMALL
from openvima.report.table import Line, Table, markdown
from tables import tables
from weights import facts, settings, ship, shipped

OUT = Path("results/2026-11-26_small")
IMAGES = Path("docs/images")
MARK = "<!-- small:{name} -->"
END = "<!-- /small:{name} -->"
_FIGURES = {
    "animation": "openvima-small at work on six tasks, each with its prompt",
    "levels": "Success of openvima-small at the four levels beside published models",
    "failures": "Failed episodes: prompt, first picture with the actions, and why they failed",
}
_DRAWN_ELSEWHERE = {"animation": "openvima_small.webp"}  # by `animation.py`
_PAGE = """# openvima-small

- Command: `{command}`
- Machine of that command: {machine}; commit `{commit}`

{sections}
"""


def record(findings: Findings) -> dict[str, Any]:
    """Return all numbers as plain values; outcomes of single episodes stay with the evaluations."""
    return {
        "scores": {name: _score_record(results) for name, results in findings.scores.items()},
        "baselines": [_training_record(training) for training in findings.baselines],
        "guesses": {level: [list(pair) for pair in pairs] for level, pairs in findings.guesses.items()},
    }


def _score_record(results: Results) -> dict[str, Any]:
    return {
        "weights": next(iter(results.policies.values())).get("sha256", ""),
        "config": results.config,
        "versions": results.versions,
        "levels": [_mean_record(mean) | {"ablation": mean.ablation} for mean in results.level_means()],
        "tasks": [_row_record(row) for row in results.rows],
    }


def _mean_record(mean: LevelMean) -> dict[str, Any]:
    return {
        "level": mean.level,
        "mean": round(mean.mean, 6),
        "interval": [round(end, 6) for end in mean.interval],
        "tasks": len(mean.tasks),
    }


def _row_record(row: Row) -> dict[str, Any]:
    return {
        "task": row.task,
        "level": row.level,
        "ablation": row.ablation,
        "successes": row.successes,
        "episodes": row.episodes,
        "interval": [round(end, 6) for end in row.interval],
        "seeds": [row.outcomes[0].seed, row.outcomes[-1].seed],
        "failures": row.failures,
    }


def _training_record(training: Training) -> dict[str, Any]:
    return {
        "name": training.name,
        "what": training.what,
        "demonstrations": training.demonstrations,
        "steps": training.steps,
        "minutes": training.minutes,
        "parameters": training.parameters,
        "episodes": sorted({row.episodes for row in training.results.rows}),
        "levels": [_mean_record(mean) for mean in level_means(training.results).values()],
    }


def recorded_means(recorded: Mapping[str, Any]) -> dict[str, LevelMean]:
    """Return success by level of the bundled weights, from a record; empty where it has none."""
    levels = recorded.get("scores", {}).get("default", {}).get("levels", [])
    return {
        each["level"]: LevelMean(POLICY, each["level"], each["mean"], tuple(each["interval"]), ())
        for each in levels
    }


def fill(text: str, fragments: Mapping[str, str | None], *, where: str) -> str:
    """Put fragments between their marks.

    Args:
        text: A page in Markdown.
        fragments: What belongs between the marks of a name; None leaves what is there.
        where: Name of the page, for errors.

    Raises:
        ConfigError: A mark has no end, or bears a name that there is no fragment for.
    """
    for name in re.findall(MARK.format(name=r"(\S+)"), text):
        if name not in fragments or END.format(name=name) not in text:
            raise ConfigError(
                f"{where} has {MARK.format(name=name)}; it needs {END.format(name=name)} after it, and "
                f"one of the names {', '.join(fragments)}."
            )
        start, end = MARK.format(name=name), END.format(name=name)
        pattern = re.escape(start) + ".*?" + re.escape(end)
        if (fragment := fragments[name]) is None:
            continue
        between = "\n\n".join(filter(None, (start, fragment, end)))
        text = re.sub(pattern, lambda _, between=between: between, text, flags=re.DOTALL)
    return text


def write(
    findings: Findings,
    out: Path,
    images: Path,
    pages: Sequence[Path],
    where: Mapping[str, Any],
    evaluation: Path | None = None,
) -> None:
    """Write record, figures and tables.

    Args:
        findings: What was found.
        out: The record without suffix.
        images: Folder of the figures.
        pages: Markdown files with marks.
        where: Machine, versions and commit, as of `sim.circumstances`.
        evaluation: Folder of an evaluation with recorded actions, whose failures are drawn.

    Raises:
        ConfigError: The record has evaluations that are not among others that are.
    """
    kept = out.with_suffix(".json")
    recorded = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    lacking = recorded.get("scores", {}).keys() - findings.scores.keys()
    if findings.scores and lacking:
        raise ConfigError(
            f"{kept} has the evaluations {', '.join(sorted(lacking))}, which are absent here; give all of "
            "them, none at all, or another --out."
        )
    new = {name: found for name, found in record(findings).items() if found or name not in recorded}
    atomic_write_file(kept, json.dumps({**recorded, **new, **where}, indent=2, ensure_ascii=False) + "\n")
    absent = None if recorded else "Not measured for these weights."
    drawn = save_all(findings, images)
    drawn |= {name: images / file for name, file in _DRAWN_ELSEWHERE.items() if (images / file).exists()}
    if evaluation and (file := draw_failures(evaluation, images / "openvima_small_failures.png")):
        drawn["failures"] = file
    made = {name: text or absent for name, text in tables(findings, recorded_means(recorded)).items()}
    made |= weights_tables(BUNDLED[SMALL])
    page = out.with_suffix(".md")
    if not page.exists():
        sections = "\n\n".join(
            f"## {name.replace('_', ' ').capitalize()}\n\n{MARK.format(name=name)}\n{END.format(name=name)}"
            for name in made
        )
        command = f"python experiments/openvima_small/publish.py SCORES --out {out}"
        atomic_write_file(page, _PAGE.format(sections=sections, command=command, **where))
    for path in (*pages, page):
        figures = {
            f"{name}-figure": f"![{_FIGURES[name]}]({Path(os.path.relpath(file, path.parent)).as_posix()})"
            for name, file in drawn.items()
        }
        figures |= {f"{name}-figure": None if recorded else "" for name in _FIGURES if name not in drawn}
        atomic_write_file(path, fill(path.read_text(encoding="utf-8"), made | figures, where=str(path)))


def weights_tables(folder: Path) -> dict[str, str]:
    """Return the tables about the bundled weights and their run; empty where its record is absent."""
    about = shipped(folder)
    pairs = {"facts": facts(about) if about else [], "recipe": settings(folder) if about else []}
    return {name: _pair_table(rows) if rows else "" for name, rows in pairs.items()}


def _pair_table(pairs: Sequence[tuple[str, str]]) -> str:
    lines = tuple(Line(name, (value,)) for name, value in pairs)
    return markdown([Table("pairs", "", ("", ""), lines)]).strip()


def main() -> None:
    """Ship weights, or write record, figures and tables of evaluations."""
    folder = BUNDLED[SMALL]
    default = [Path("README.md"), Path("docs/openvima_small.md"), folder / MODEL_CARD]
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("scores", type=Path, nargs="?", help="folder of the folders of evaluations")
    parser.add_argument("--run", type=Path, help="training whose best checkpoint becomes the bundled one")
    parser.add_argument("--data", type=Path, help="its demonstrations, unless training_data.json lists them")
    parser.add_argument(
        "--failures", type=Path, help="evaluation to draw failures of, in place of SCORES/default"
    )
    parser.add_argument("--out", type=Path, default=OUT, help="path of the record, without suffix")
    parser.add_argument("--images", type=Path, default=IMAGES, help="folder of the figures")
    parser.add_argument("--fill", type=Path, nargs="*", default=default, help="pages with marked tables")
    given = parser.parse_args()
    if given.scores is None and given.run is None:
        parser.error("give SCORES, a folder of evaluations, or --run RUN.")
    try:
        if given.run is not None:
            ship(given.run, folder, given.data)
            print(f"{folder}: weights {weights_hash(folder)[:12]} of {given.run}")
        if given.scores is None:
            return
        from sim import circumstances

        findings = find(given.scores, weights_hash(folder))
        evaluation = given.failures or given.scores / "default"
        if not (evaluation / ACTIONS_NAME).is_file():
            print(f"{evaluation} has no {ACTIONS_NAME}; the figure of failures is left out.", file=sys.stderr)
            evaluation = None
        write(findings, given.out, given.images, given.fill, circumstances(), evaluation)
    except OpenVimaError as error:
        parser.error(str(error))
    for name in findings.scores:
        means = [f"{x} {100 * mean.mean:.1f}" for x, mean in findings.means(name).items()]
        print(f"{name}: {', '.join(means)}", file=sys.stderr)


if __name__ == "__main__":
    main()
