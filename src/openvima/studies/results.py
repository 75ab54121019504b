"""Results of a study: means over training seeds, differences and costs, and the page that shows them."""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from openvima.evaluation.ablations import ablation_parts, scenes_of
from openvima.evaluation.results import Results, group_by_key
from openvima.evaluation.statistics import (
    Interval,
    PairCounts,
    SeedMean,
    difference_over_seeds,
    mean_over_seeds,
)
from openvima.html import render_page
from openvima.input_files import read_json
from openvima.report import text
from openvima.report.figures import RateFigure, RatePoint, rate_figure_html
from openvima.report.published import RELIABILITY
from openvima.report.text import ablation_name
from openvima.studies.plan import COST_FILE, Plan
from openvima.studies.study import PublishedPoint, Run, Study


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


def study_points(plan: Plan) -> list[Point]:
    """Read the evaluations of a study; points in the order of runs, ablations and levels."""
    study = plan.study
    found = group_by_key((each.run.label, Results.read(each.config.out)) for each in plan.evaluations)
    points = []
    for run in study.runs:
        has_plain, results = (run.evaluation or study.evaluation).plain, found[run.label]
        ablations = dict.fromkeys(row.ablation for row in results[0].rows if row.ablation)
        for ablation in (*([""] if has_plain else []), *ablations):
            for level in results[0].levels():
                is_own = bool(ablation) and has_plain  # compared with the same run without ablation
                reference = (results, "") if is_own else (found[study.runs[0].label], ablation)
                if point := _point(study, run, (results, ablation), reference, level):
                    points.append(point)
    return points


_Scores = tuple[Sequence[Results], str]  # of each seed, and the ablation
_Outcomes = Mapping[str, Mapping[int, bool]]  # success by task and seed of the episode


def _point(study: Study, run: Run, scores: _Scores, reference: _Scores, level: str) -> Point | None:
    """Return a mean; None if the level holds none of the tasks that the ablation applies to."""
    outcomes, ablation = _outcomes(scores, level), scores[1]
    if not outcomes[0]:
        return None
    counts = [[(sum(o.values()), len(o)) for o in of_seed.values()] for of_seed in outcomes]
    series = run.series or (run.label if study.x_axis != "run" else "")
    if ablation and study.x_axis == "run":
        series = " · ".join(filter(None, (series, ablation_name(ablation))))
    is_paired = scores != reference and scenes_of(ablation) == scenes_of(reference[1])
    difference = _difference(outcomes, _outcomes(reference, level)) if is_paired else None
    return Point(
        run.label,
        series,
        _position(study, run, level, ablation),
        level,
        ablation,
        tuple(outcomes[0]),
        counts[0][0][1],
        mean_over_seeds(counts),
        *(difference or (None, None)),
    )


def _position(study: Study, run: Run, level: str, ablation: str) -> float | str:
    if study.x_axis == "level":
        return level
    if study.x_axis == "ablation":
        return ablation_name(ablation) or "as it is"
    if study.x_axis == "rate":
        return sum(part.rate for part in ablation_parts(ablation))
    return run.label if run.x == "" else run.x


def _difference(outcomes: Sequence[_Outcomes], others: Sequence[_Outcomes]) -> tuple[float, Interval] | None:
    """Difference over the tasks of both, on the same episodes; None if there are none."""
    if len(outcomes) != len(others):
        return None
    tasks = [t for t, played in outcomes[0].items() if played.keys() == others[0].get(t, {}).keys()]
    if not tasks:
        return None
    pairs = zip(outcomes, others, strict=True)
    return difference_over_seeds(
        [[PairCounts.of((a[t][seed], b[t][seed]) for seed in a[t]) for t in tasks] for a, b in pairs]
    )


def _outcomes(scores: _Scores, level: str) -> list[dict[str, dict[int, bool]]]:
    """Success by task and seed of the episode, for each training seed."""
    results, ablation = scores
    return [
        {
            row.task: {outcome.seed: outcome.success for outcome in row.outcomes}
            for row in of_seed.rows
            if (row.level, row.ablation) == (level, ablation)
        }
        for of_seed in results
    ]


def study_costs(plan: Plan) -> dict[str, list[dict[str, Any]]]:
    """Read the costs of the trainings, by label; those that others start from under an empty one."""
    return group_by_key((each.run, read_json(each.config.out / COST_FILE)) for each in plan.all_trainings)


def study_page(
    plan: Plan,
    points: Sequence[Point],
    *,
    costs: Mapping[str, Sequence[Mapping[str, Any]]],
    versions: Mapping[str, str],
    command: str,
) -> str:
    """Render the page.

    Args:
        plan: The study and its stages.
        points: Its means.
        costs: Costs of the trainings by run, one entry a seed.
        versions: Versions of the packages that results depend on.
        command: The command that repeats the study.
    """
    study, levels = plan.study, list(dict.fromkeys(point.level for point in points))
    figure = study_figure(study, points)
    return render_page(
        "study",
        study=study,
        scale=plan.inputs.scale,
        num_seeds=max(len(point.score.seeds) for point in points),
        levels=levels,
        figure=rate_figure_html(figure),
        rows=_by_level(((point.run, point.ablation), point) for point in points),
        published_rows=_by_level((_published_name(point, figure), point) for point in study.published),
        tasks={level: max((p.tasks for p in points if p.level == level), key=len) for level in levels},
        points=points,
        costs=costs,
        reliability=RELIABILITY if study.published else "",
        versions=versions,
        command=command,
        text=text,
    )


def study_figure(study: Study, points: Sequence[Point]) -> RateFigure:
    """Return the figure: a panel a level, or a single one with the levels on its axis.

    Values of the quantity that are names are numbered in the order in which they appear.
    """
    shown = (*points, *study.published)
    values = list(dict.fromkeys(point.x for point in shown))
    named = any(isinstance(value, str) for value in values)

    def placed(point: Point | PublishedPoint) -> tuple[tuple[str, bool], RatePoint]:
        """Return the curve of a point, and its place."""
        x = float(values.index(point.x) if named else point.x)
        if isinstance(point, PublishedPoint):
            return (point.series, True), RatePoint(x, point.rate)
        score = point.score
        seeds = tuple(mean for mean, _ in score.seeds) if len(score.seeds) > 1 else ()
        return (point.series or "this study", False), RatePoint(x, score.mean, score.interval, seeds)

    panels = {}
    for level in [""] if study.x_axis == "level" else dict.fromkeys(point.level for point in points):
        curves = group_by_key(placed(point) for point in shown if level in ("", point.level))
        panels[level or "All levels"] = {
            name: sorted(found, key=lambda point: point.x) for name, found in curves.items()
        }
    return RateFigure(
        caption=study.question,
        quantity=study.quantity,
        panels=panels,
        ticks={float(index): str(value) for index, value in enumerate(values)} if named else study.ticks,
        logarithmic=study.logarithmic,
        named=named,
    )


def _by_level(named: Iterable[tuple[Hashable, Point | PublishedPoint]]) -> Mapping[Hashable, Mapping]:
    """Arrange points by the name of their row, then by level."""
    return {name: {point.level: point for point in found} for name, found in group_by_key(named).items()}


def _published_name(point: PublishedPoint, figure: RateFigure) -> str:
    x = point.x if isinstance(point.x, str) else figure.tick(point.x)
    return point.series if x == point.level else f"{point.series} · {x}"
