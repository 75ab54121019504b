"""Tables about openvima-small, in Markdown, by the name of their place in the pages."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from findings import (
    EVALUATIONS,
    LEVELS,
    POLICY,
    PUBLISHED_DEMONSTRATIONS,
    SIMULATORS,
    SWAPPED,
    TEXT_ABLATIONS,
    Findings,
)
from openvima.evaluation.results import LevelMean, Results, Row
from openvima.evaluation.statistics import mean_of_rates
from openvima.policies.naming import BUNDLED
from openvima.report.published import PublishedModel, leading_models, published_models
from openvima.report.table import Estimate, Line, Table, markdown
from openvima.report.tables import paper_tables
from openvima.report.text import ablation_name, counted
from weights import shipped

_BESIDE = (("MIDAS", "92M"), ("VIMA", "200M"), ("VIMA", "9M"))  # best, best known, of similar size
_PREVIOUS = ("7.3M", "52,000")  # parameters and demonstrations
_CHANCE = 1 / 3  # with the other attribute: docs/evaluation.md
_SETTINGS = tuple(name for name in EVALUATIONS if name not in ("controls", "text"))
_IN_SIMULATOR = (
    "In the original simulator, with its assets and its order of objects. Training has seen none of them."
)
_HERE = "In this package, boxes from the segmentation unless stated."
_LEAST_SOLVED = 0.95  # tasks below are listed with their failures
_MOST_KINDS = 2  # of failures of a task


def tables(findings: Findings, recorded: Mapping[str, LevelMean]) -> dict[str, str]:
    """Return all tables, by the name of their place; those without data are empty or say so.

    Args:
        findings: What was found.
        recorded: Means by level of the bundled weights, as in the record, for lack of a new score.
    """
    of, whole = findings.scores, published_models()
    beside = [next(m for m in whole if (m.model, m.size, m.data_fraction) == (*name, 1)) for name in _BESIDE]
    others = [model for model in leading_models() if model not in beside]
    made = {
        "simulator": _level_table(findings, SIMULATORS, beside, _IN_SIMULATOR),
        "levels": _level_table(findings, {"default": POLICY}, [*beside, *others], _HERE),
        "settings": _level_table(findings, {name: EVALUATIONS[name] for name in _SETTINGS}, beside, _HERE),
        "tasks": _task_table(of.get("default")),
        "simulator_tasks": _task_table(of.get("simulator"), "In the published benchmark itself."),
        "original_tasks": _task_table(
            of.get("original_assets"), "With the assets of the original benchmark."
        ),
        "text": _text_table(of.get("text")),
        "controls": _control_table(of.get("controls"), findings.guesses),
        "swapped_attribute": _swapped_table(of.get("controls")),
        "failures": _failure_table(of.get("default")),
        "baselines": _baseline_table(findings, recorded) if findings.baselines else None,
    }
    written = {
        name: markdown([table]).strip() if table and table.lines else "" for name, table in made.items()
    }
    return written | {name: findings.ablations.get(name, "") for name in ("ablations", "attributes")}


def _level_table(
    findings: Findings, shown: Mapping[str, str], models: Sequence[PublishedModel], where: str
) -> Table | None:
    """Means by level of scores, by their name and what they are, and of published models."""
    found = {what: means for name, what in shown.items() if (means := findings.means(name))}
    if not found:
        return None
    own = shipped(BUNDLED[POLICY])
    ours = (f"{own.parameters / 1e6:.1f}M", f"{own.episodes:,}") if own else ("–", "–")
    columns = ("", "parameters", "demonstrations") if models else ("",)
    lines = []
    for what, means in found.items():
        about = _PREVIOUS if what.startswith("previous") else ours
        lines.append(Line(what, (*(about if models else ()), *_cells(means, LEVELS))))
    for model in models:
        rates = (model.written(level, model.levels[level]).rstrip("*†‡") for level in LEVELS)
        cells = (f"{model.size} and T5", f"{PUBLISHED_DEMONSTRATIONS:,}", *rates)
        lines.append(Line(f"{model.model}, published", cells))
    counts = (row.episodes for name in shown for row in _plain(findings.scores.get(name)))
    return Table("levels", f"{where} {_caption(counts)}", (*columns, *LEVELS), tuple(lines))


def _task_table(results: Results | None, where: str = "") -> Table | None:
    if results is None:
        return None
    found = next(t for t in paper_tables(results, published=False) if t.label == f"tasks-{POLICY}")
    return replace(found, caption=f"{where} {found.caption}".strip())


def _text_table(results: Results | None) -> Table | None:
    """Tasks, unablated and in other words."""
    if results is None:
        return None
    columns = ("", *TEXT_ABLATIONS)
    rows = {(row.task, row.level, row.ablation): row for row in results.rows}
    cells = [(task, level) for task, level, ablation in rows if ablation == ""]
    lines = [
        Line(f"{task}, {level}", tuple(_rate(rows.get((task, level, ablation))) for ablation in columns))
        for task, level in cells
    ]
    means = []
    for ablation in columns:
        own = [row for row in results.rows if row.ablation == ablation]
        counts = [(row.successes, row.episodes) for row in own]
        of = "" if len(own) == len(cells) else f"{len(own)} tasks"
        means.append(Estimate(*mean_of_rates(counts), mark=of) if own else "–")
    lines.append(Line("mean", tuple(means), starts_group=True))
    heads = ("task", "multimodal", *(ablation_name(ablation) for ablation in columns[1:]))
    return Table("text", _caption(row.episodes for row in results.rows), heads, tuple(lines))


def _control_table(results: Results | None, guesses: Mapping[str, Sequence[tuple[int, int]]]) -> Table | None:
    """Means by level under each ablation, and of a policy that moves any object to any container."""
    if results is None:
        return None
    means = results.means()
    lines = [
        Line(
            ablation_name(ablation) if ablation else "none",
            tuple(_estimate(means.get((POLICY, ablation, level))) for level in LEVELS),
        )
        for ablation in dict.fromkeys(row.ablation for row in results.rows)
        if ablation != SWAPPED
    ]
    if guesses:
        cells = (Estimate(*mean_of_rates(guesses[level])) if level in guesses else "–" for level in LEVELS)
        lines.append(Line("a guess in place of the policy", tuple(cells)))
    counts = (row.episodes for row in results.rows)
    return Table("controls", _caption(counts), ("ablation", *LEVELS), tuple(lines))


def _swapped_table(results: Results | None) -> Table | None:
    """Success with the attribute word of the prompt, and with the other one."""
    swapped = [row for row in results.rows if row.ablation == SWAPPED] if results else []
    lines = []
    for row in swapped:
        plain = results.row(POLICY, row.task, row.level) if results else None
        cells = (_rate(plain), _rate(row), f"{100 * _CHANCE:.1f}")
        lines.append(Line(f"{row.task}, {row.level}", cells))
    heads = ("task", "its attribute", "the other attribute", "chance")
    return Table("swapped", _caption(row.episodes for row in swapped), heads, tuple(lines))


def _failure_table(results: Results | None) -> Table | None:
    """Tasks that are solved least often, with the most frequent failures."""
    if results is None:
        return None
    weak = sorted((row for row in _plain(results) if row.rate < _LEAST_SOLVED), key=lambda row: row.rate)
    lines = []
    for row in weak:
        kinds = list(row.failures.items())[:_MOST_KINDS]
        why = "; ".join(f"{kind} ({count})" for kind, count in kinds)
        lines.append(Line(f"{row.task}, {row.level}", (_rate(row), why)))
    caption = f"{_caption(row.episodes for row in weak)} Failures with the number of their episodes."
    return Table("failures", caption, ("task", "solved", "most frequent failures"), tuple(lines))


def _baseline_table(findings: Findings, recorded: Mapping[str, LevelMean]) -> Table:
    """Architectures that were trained on the same demonstrations for the same time, and ours."""
    trainings, own = findings.baselines, shipped(BUNDLED[POLICY])
    levels = list(dict.fromkeys(level for training in trainings for level in training.means()))
    lines = []
    if own is not None:
        cells = (
            f"{own.parameters / 1e6:.1f}M",
            " + ".join(f"{each:,}" for each in own.steps),
            f"{own.hours:.1f}",
        )
        lines = [Line(POLICY, (*cells, *_cells(findings.means() or recorded, levels)))]
    lines += [
        Line(
            training.what,
            (
                f"{training.parameters / 1e6:.1f}M",
                f"{training.steps:,}",
                f"{training.minutes / 60:.1f}",
                *_cells(training.means(), levels),
            ),
        )
        for training in trainings
    ]
    counts = (row.episodes for training in trainings for row in _plain(training.results))
    return Table("baselines", _caption(counts), ("", "parameters", "steps", "hours", *levels), tuple(lines))


def _cells(means: Mapping[str, LevelMean], levels: Sequence[str]) -> tuple[Estimate | str, ...]:
    return tuple(_estimate(means.get(level)) for level in levels)


def _estimate(mean: LevelMean | None) -> Estimate | str:
    return Estimate(mean.mean, mean.interval) if mean else "–"


def _rate(row: Row | None) -> Estimate | str:
    return Estimate(row.rate, row.interval) if row else "–"


def _plain(results: Results | None) -> list[Row]:
    return [row for row in results.rows if not row.ablation] if results else []


def _caption(episodes: Iterable[int]) -> str:
    """Say what numbers are, and over how many episodes."""
    counts = sorted(set(episodes))
    if not counts:
        return "Published success rates."
    several = f"{counts[0]:,} to " * (len(counts) > 1)
    return f"Success rate in %, with 95 % intervals; {several}{counted(counts[-1], 'episode')} a task."
