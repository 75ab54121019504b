"""Results of a study: means over training seeds, differences and costs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from openvima.evaluation.results import Results
from openvima.evaluation.statistics import (
    Interval,
    PairCounts,
    SeedMean,
    difference_over_seeds,
    mean_over_seeds,
)
from openvima.input_files import read_json
from openvima.report.text import ablation_name
from openvima.studies.plan import COST_FILE, Plan
from openvima.studies.study import Run, Study


@dataclass(frozen=True, slots=True)
class Point:
    """One mean of a study.

    Args:
        run: Label of the run.
        series: Curve of the figure.
        x: Value or name on the x axis.
        level: Level.
        ablation: Input ablation; empty for none.
        tasks: Tasks of the mean.
        episodes: Episodes of each task and seed.
        score: Mean over seeds and tasks.
        difference: From the first run, or from the same run without ablation, on the same episodes; None for
            these, and where seeds, tasks or episodes differ.
        difference_interval: Its 95 % interval.
    """

    run: str
    series: str
    x: float | str
    level: str
    ablation: str
    tasks: tuple[str, ...]
    episodes: int
    score: SeedMean
    difference: float | None = None
    difference_interval: Interval | None = None


def study_points(study: Study, plan: Plan) -> list[Point]:
    """Read the evaluations of a study; points in the order of runs, ablations and levels."""
    found: dict[str, list[Results]] = {}
    for evaluation in plan.evaluations:
        found.setdefault(evaluation.run.label, []).append(Results.read(evaluation.config.out))
    points = []
    for run in study.runs:
        settings = run.evaluation or study.evaluation
        results = found[run.label]
        for ablation in (*([""] if settings.plain else []), *_ablations(results)):
            for level in results[0].levels():
                reference = (
                    (results, "") if ablation and settings.plain else (found[study.runs[0].label], ablation)
                )
                points.append(_point(study, run, results, ablation, level, reference))
    return points


def _point(
    study: Study,
    run: Run,
    results: Sequence[Results],
    ablation: str,
    level: str,
    reference: tuple[Sequence[Results], str],
) -> Point:
    outcomes = [_outcomes(of_seed, level, ablation) for of_seed in results]
    tasks = tuple(outcomes[0])
    counts = [[(sum(o.values()), len(o)) for o in of_seed.values()] for of_seed in outcomes]
    others = [_outcomes(of_seed, level, reference[1]) for of_seed in reference[0]]
    x = {"run": run.x or run.label, "level": level, "ablation": ablation_name(ablation) or "as it is"}[
        study.x_axis
    ]
    series = run.series or (run.label if study.x_axis != "run" else "")
    if ablation and study.x_axis == "run":
        series = " · ".join(filter(None, (series, ablation_name(ablation))))
    difference = None if others == outcomes else _difference(outcomes, others)
    return Point(
        run.label,
        series,
        x,
        level,
        ablation,
        tasks,
        counts[0][0][1],
        mean_over_seeds(counts),
        *(difference or (None, None)),
    )


def _difference(
    outcomes: Sequence[Mapping[str, Mapping[int, bool]]], others: Sequence[Mapping[str, Mapping[int, bool]]]
) -> tuple[float, Interval] | None:
    """Difference on the same episodes; None if they are not the same."""
    keys = [[(task, tuple(o)) for task, o in of_seed.items()] for of_seed in outcomes]
    if keys != [[(task, tuple(o)) for task, o in of_seed.items()] for of_seed in others]:
        return None
    return difference_over_seeds(
        [[_pair_counts(a[task], b[task]) for task in a] for a, b in zip(outcomes, others, strict=True)]
    )


def _pair_counts(a: Mapping[int, bool], b: Mapping[int, bool]) -> PairCounts:
    pairs = [(a[seed], b[seed]) for seed in a]
    return PairCounts(
        *(pairs.count(pair) for pair in ((True, True), (True, False), (False, True), (False, False)))
    )


def _outcomes(results: Results, level: str, ablation: str) -> dict[str, dict[int, bool]]:
    """Success by task and seed of the episode."""
    return {
        row.task: {outcome.seed: outcome.success for outcome in row.outcomes}
        for row in results.rows
        if (row.level, row.ablation) == (level, ablation)
    }


def _ablations(results: Sequence[Results]) -> list[str]:
    return [name for name in dict.fromkeys(row.ablation for row in results[0].rows) if name]


def study_costs(plan: Plan) -> dict[str, list[dict[str, Any]]]:  # Any: JSON
    """Read the costs of the trainings, by label; those that others start from under an empty one."""
    costs: dict[str, list[dict[str, Any]]] = {}
    for training in (*plan.initial, *plan.trainings):
        costs.setdefault(training.run, []).append(read_json(training.config.out / COST_FILE))
    return costs
