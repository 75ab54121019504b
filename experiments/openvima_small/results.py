"""Turn evaluations of openvima-small into its record, its tables and its figures.

    PYTHONPATH=benchmarks python experiments/openvima_small/results.py EVALUATION --trainings FILES

EVALUATION is written by `openvima evaluate --policy openvima-small --ablations all --out EVALUATION`. Each
file of `--trainings` contains a record of `ablations.py`, or a list of them: name, what, demonstrations,
steps, minutes, and evaluation, the path of a results.json. Trainings with the demonstrations and steps of
`--baseline` are compared with it; those with other numbers of demonstrations form the scaling curve. Names
that begin with "vima" are VIMA's architecture.

The script writes OUT.json, the figures, and the tables between `<!-- small:NAME -->` and
`<!-- /small:NAME -->` in each file of `--fill`. OUT.md is created if missing.
"""

import argparse
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from figures import save_all
from findings import (
    DEMONSTRATIONS,
    LEVELS,
    POLICY,
    PUBLISHED_DEMONSTRATIONS,
    Findings,
    Training,
    find,
    read_trainings,
)
from openvima.atomic_io import atomic_write_file
from openvima.errors import ConfigError, OpenVimaError
from openvima.evaluation.comparison import Comparison
from openvima.evaluation.results import LevelMean, Results, Row
from openvima.evaluation.statistics import mean_of_rates
from openvima.policies.bundled import BUNDLED
from openvima.policies.checkpoint import read_info
from openvima.policies.parameter_counts import policy_size
from openvima.report.paper import paper_tables
from openvima.report.published import PublishedModel, leading_models, published_models
from openvima.report.typesetting import Estimate, Line, Table, markdown
from sim import circumstances

OUT = Path("results/2026-11-22_small")
IMAGES = Path("docs/images")
FILL = (Path("README.md"), Path("docs/openvima_small.md"))
BESIDE = (
    ("MIDAS", "92M"),
    ("VIMA", "200M"),
    ("VIMA", "9M"),
)  # in the short table: best, best known, of similar size
MARK = "<!-- small:{name} -->"
END = "<!-- /small:{name} -->"
_ANIMATION = "openvima_small.webp"  # that `experiments/openvima_small/animation.py` makes
_FIGURES = {
    "animation": "openvima-small at work on six tasks, each with its prompt",
    "levels": "Success of openvima-small at the four levels beside published models",
    "scaling": "Success against the number of demonstrations",
    "ablations": "Success of the full model and of variants without one component",
}
_PAGE = """# openvima-small: scores, ablations, scaling

- Weights: TODO(numbers): how trained, machine, hours
- Command: `{command}`
- Machine of that command: {machine}; commit `{commit}`

TODO(numbers): what it shows, and what it does not.

## Levels

{levels}

## Tasks

{tasks}

## Input ablations

{input_ablations}

## Parts

{ablations}

## Data

{scaling}
"""


# The record.


def record(findings: Findings) -> dict[str, Any]:  # Any: plain JSON values
    """Return all numbers as plain values; outcomes of single episodes stay with the evaluations."""
    results = findings.results
    own = [row for row in results.rows if row.policy == findings.policy]
    return {
        "policy": findings.policy,
        "weights": results.policies.get(findings.policy, {}).get("sha256", ""),
        "demonstrations": findings.demonstrations,
        "levels": [
            _mean_record(mean) | {"ablation": mean.ablation, "within_oracle_steps": _strict(mean, own)}
            for mean in results.level_means()
            if mean.policy == findings.policy
        ],
        "tasks": [_row_record(row) for row in own],
        "trainings": [_training_record(training) for training in findings.trainings],
        "differences_to": findings.baseline.name if findings.baseline else "",
        "differences": [comparison.record() for comparison in findings.differences.values()],
        "config": results.config,
        "evaluation_versions": results.versions,
    }


def _mean_record(mean: LevelMean) -> dict[str, Any]:  # Any: plain JSON values
    return {
        "level": mean.level,
        "mean": round(mean.mean, 6),
        "interval": [round(end, 6) for end in mean.interval],
        "tasks": len(mean.tasks),
    }


def _strict(mean: LevelMean, rows: Sequence[Row]) -> float:
    """The same mean with no more steps than the oracle may take."""
    chosen = [row for row in rows if (row.level, row.ablation) == (mean.level, mean.ablation)]
    return round(mean_of_rates([(row.successes_oracle_horizon, row.episodes) for row in chosen])[0], 6)


def _row_record(row: Row) -> dict[str, Any]:  # Any: plain JSON values
    return {
        "task": row.task,
        "level": row.level,
        "ablation": row.ablation,
        "successes": row.successes,
        "episodes": row.episodes,
        "interval": [round(end, 6) for end in row.interval],
        "failures": row.failures,
    }


def _training_record(training: Training) -> dict[str, Any]:  # Any: plain JSON values
    return {
        "name": training.name,
        "what": training.what,
        "demonstrations": training.demonstrations,
        "steps": training.steps,
        "minutes": training.minutes,
        "parameters": training.parameters,
        "episodes": sorted({row.episodes for row in training.results.rows}),
        "levels": [_mean_record(mean) for mean in training.means().values()],
    }


# Tables.


def tables(findings: Findings) -> dict[str, str]:
    """Return all tables in Markdown, by the name of their place."""
    from_paper = {table.label: table for table in paper_tables(findings.results)}
    input_ablations = from_paper.get(f"input-ablations-{findings.policy}")
    made = {
        "short": _level_table(findings, _beside()),
        "levels": _level_table(findings, [*_beside(), *(m for m in leading_models() if m not in _beside())]),
        "tasks": from_paper[f"tasks-{findings.policy}"],
        "input_ablations": input_ablations or _empty("no input ablation was evaluated"),
        "ablations": _ablation_table(findings) if findings.differences else _empty("none"),
        "scaling": _scaling_table(findings) if findings.trainings else _empty("none"),
    }
    return {name: markdown([table]).strip() for name, table in made.items()}


def _empty(why: str) -> Table:
    return Table("none", "", (why,), ())


def _beside() -> list[PublishedModel]:
    whole = {(model.model, model.size): model for model in published_models() if model.data_fraction == 1}
    return [whole[name] for name in BESIDE]


def _level_table(findings: Findings, models: Sequence[PublishedModel]) -> Table:
    means, size = (
        findings.means(),
        policy_size(read_info(BUNDLED["openvima-small"].folder).config).parameters.total,
    )
    own = (f"{size / 1e6:.1f}M", f"{findings.demonstrations:,}", *(_estimate(means.get(x)) for x in LEVELS))
    lines = [Line(findings.policy, own)]
    for model in models:
        cells = (f"{model.size} and T5", f"{PUBLISHED_DEMONSTRATIONS:,}")
        rates = (model.written(level, model.levels[level], keep_marks=False) for level in LEVELS)
        lines.append(Line(f"{model.model}, published", (*cells, *rates)))
    return Table("levels", "", ("", "parameters", "demonstrations", *LEVELS), tuple(lines))


def _ablation_table(findings: Findings) -> Table:
    assert findings.baseline  # there is none without differences
    levels = list(findings.baseline.means())
    lines = [_training_line(findings.baseline, levels, None)]
    lines += [_training_line(t, levels, findings.differences[t.name]) for t in findings.variants]
    columns = [column for level in levels for column in (level, "difference")]
    return Table("ablations", "", ("", *columns), tuple(lines))


def _training_line(training: Training, levels: Sequence[str], comparison: Comparison | None) -> Line:
    means, cells = training.means(), []
    differences = {difference.level: difference for difference in comparison.levels} if comparison else {}
    for level in levels:
        cells.append(_estimate(means.get(level)))
        found = differences.get(level)
        mark = "≈" if found and found.verdict == "noise" else ""
        cells.append(Estimate(found.difference, found.interval, True, mark) if found else "")
    return Line(training.what, tuple(cells))


def _scaling_table(findings: Findings) -> Table:
    shown = [*findings.curve(vima=False), *findings.curve(vima=True)]
    levels = list(dict.fromkeys(level for training in shown for level in training.means()))
    lines = [
        Line(
            "VIMA's architecture" if training.is_vima else "preset small",
            (
                f"{training.demonstrations:,}",
                f"{training.steps:,}",
                f"{training.minutes:.0f}",
                *(_estimate(training.means().get(level)) for level in levels),
            ),
            starts_group=training.is_vima,
        )
        for training in shown
    ]
    return Table("scaling", "", ("", "demonstrations", "steps", "minutes", *levels), tuple(lines))


def _estimate(mean: LevelMean | None) -> Estimate | str:
    return Estimate(mean.mean, mean.interval) if mean else "–"


# Files.


def fill(text: str, fragments: Mapping[str, str], *, where: str) -> str:
    """Put fragments between their marks.

    Args:
        text: A page in Markdown.
        fragments: What belongs between the marks of a name.
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
        between = f"{start}\n\n{fragments[name]}\n\n{end}"
        text = re.sub(pattern, lambda _, between=between: between, text, flags=re.DOTALL)
    return text


def write(findings: Findings, out: Path, images: Path, pages: Sequence[Path], where: dict[str, Any]) -> None:
    """Write record, figures and tables.

    Args:
        findings: What was found.
        out: The record without suffix.
        images: Folder of the figures.
        pages: Markdown files with marks.
        where: Machine, versions and commit, as of `sim.circumstances`.
    """
    content = json.dumps(record(findings) | where, indent=2, ensure_ascii=False) + "\n"
    atomic_write_file(out.with_suffix(".json"), content)
    drawn = save_all(findings, images)
    if (images / _ANIMATION).exists():
        drawn["animation"] = images / _ANIMATION
    made = tables(findings)
    page = out.with_suffix(".md")
    if not page.exists():
        places = {name: f"{MARK.format(name=name)}\n{END.format(name=name)}" for name in made}
        script = "experiments/openvima_small/results.py"
        command = f"python {script} EVALUATION --trainings FILES --out {out}"
        atomic_write_file(page, _PAGE.format(**places, command=command, **where))
    for path in (*pages, page):
        figures = {
            f"{name}-figure": f"![{_FIGURES[name]}]({Path(os.path.relpath(file, path.parent)).as_posix()})"
            for name, file in drawn.items()
        }
        figures |= {f"{name}-figure": "" for name in _FIGURES if name not in drawn}
        atomic_write_file(path, fill(path.read_text(encoding="utf-8"), made | figures, where=str(path)))


def main() -> None:
    """Read evaluations, write record, figures and tables."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("evaluation", type=Path, help="folder or results.json of the bundled checkpoint")
    parser.add_argument("--trainings", type=Path, nargs="*", default=[], help="records of smaller trainings")
    parser.add_argument("--policy", default=POLICY, help="its name in the evaluation")
    parser.add_argument("--baseline", default="full", help="training that others are compared with")
    parser.add_argument(
        "--demonstrations", type=int, default=DEMONSTRATIONS, help="number of training demonstrations"
    )
    parser.add_argument("--out", type=Path, default=OUT, help="path of the record, without suffix")
    parser.add_argument("--images", type=Path, default=IMAGES, help="folder of the figures")
    parser.add_argument("--fill", type=Path, nargs="*", default=list(FILL), help="pages with marked tables")
    given = parser.parse_args()
    try:
        trainings = read_trainings(given.trainings)
        findings = find(
            Results.read(given.evaluation),
            trainings,
            policy=given.policy,
            baseline=given.baseline,
            demonstrations=given.demonstrations,
        )
        write(findings, given.out, given.images, given.fill, circumstances())
    except OpenVimaError as error:
        parser.error(str(error))
    for mean in findings.means().values():
        low, high = (100 * end for end in mean.interval)
        print(f"{mean.level}: {100 * mean.mean:.1f} ({low:.1f} to {high:.1f}), {len(mean.tasks)} tasks")


if __name__ == "__main__":
    main()
