"""The page of a study: figure, table, costs and published numbers, in one HTML file without scripts."""

from collections.abc import Mapping, Sequence
from typing import Any

from openvima.html import render_page
from openvima.report import text
from openvima.report.fragments import rate_figure_html
from openvima.report.published import RELIABILITY
from openvima.report.rate_curves import RateCurve, RateFigure, RatePanel, RatePoint
from openvima.studies.results import Point
from openvima.studies.study import Study, StudyInputs

_MAX_NAMED = 6  # means in the first sentence


def study_page(
    study: Study,
    inputs: StudyInputs,
    points: Sequence[Point],
    *,
    costs: Mapping[str, Sequence[Mapping[str, Any]]],  # Any: JSON
    versions: Mapping[str, str],
    command: str,
) -> str:
    """Render the page.

    Args:
        study: The study.
        inputs: What it was made from.
        points: Its means.
        costs: Costs of the trainings by run, one entry a seed.
        versions: Versions of the packages that results depend on.
        command: The command that repeats the study.
    """
    levels = list(dict.fromkeys(point.level for point in points))
    return render_page(
        "study",
        study=study,
        scale=inputs.scale,
        num_seeds=max(len(point.score.seeds) for point in points),
        levels=levels,
        figure=rate_figure_html(study_figure(study, points)),
        rows=_rows(points),
        tasks={level: max((p.tasks for p in points if p.level == level), key=len) for level in levels},
        points=points,
        costs={label: _mean_costs(of_run) for label, of_run in costs.items()},
        reliability=RELIABILITY if study.published else "",
        versions=versions,
        command=command,
        summary=_summary(points),
        percent=text.percent,
        span=text.span,
        points_of=text.points,
        points_span=text.points_span,
        duration=duration,
    )


def study_figure(study: Study, points: Sequence[Point]) -> RateFigure:
    """Return the figure: a panel a level, or a single one with the levels on its axis.

    Values of the quantity that are names are numbered in the order in which they appear.
    """
    values = list(dict.fromkeys([p.x for p in points] + [p.x for p in study.published]))
    named = any(isinstance(value, str) for value in values)
    panels = []
    for level in [""] if study.x_axis == "level" else dict.fromkeys(point.level for point in points):
        curves: dict[tuple[str, bool], list[RatePoint]] = {}
        for point in points:
            if level in ("", point.level):
                score, x = point.score, _number(point.x, values, named)
                seeds = tuple(mean for mean, _ in score.seeds) if len(score.seeds) > 1 else ()
                found = RatePoint(x, score.mean, score.interval, seeds=seeds)
                curves.setdefault((point.series or "this study", False), []).append(found)
        for point in study.published:
            if level in ("", point.level):
                found = RatePoint(_number(point.x, values, named), point.rate, mark=point.mark)
                curves.setdefault((point.series, True), []).append(found)
        of_level = (
            RateCurve(name, tuple(sorted(of_name, key=lambda point: point.x)), published)
            for (name, published), of_name in curves.items()
        )
        panels.append(RatePanel(level or "All levels", tuple(of_level)))
    return RateFigure(
        label="study",
        caption=study.question,
        quantity=study.quantity,
        panels=tuple(panels),
        ticks={float(index): str(value) for index, value in enumerate(values)} if named else study.ticks,
        logarithmic=study.logarithmic,
        named=named,
    )


def _number(value: float | str, values: Sequence[float | str], named: bool) -> float:
    return float(values.index(value) if named else value)


def _rows(points: Sequence[Point]) -> dict[tuple[str, str], dict[str, Point]]:
    """Points by run and ablation, then by level."""
    rows: dict[tuple[str, str], dict[str, Point]] = {}
    for point in points:
        rows.setdefault((point.run, point.ablation), {})[point.level] = point
    return rows


def _mean_costs(costs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:  # Any: JSON
    """Costs of one run: of a training, on average over its seeds."""
    seconds = [cost["cpu_seconds"] for cost in costs]
    return {**costs[0], "cpu_seconds": sum(seconds) / len(seconds), "total": sum(seconds)}


def _summary(points: Sequence[Point]) -> str:
    """The first means of the first level as a sentence."""
    first = points[0].level
    means = [
        f"{' · '.join(filter(None, (p.run, text.ablation_name(p.ablation))))}: {text.percent(p.score.mean)}"
        for p in points
        if p.level == first
    ]
    more = f", and {len(means) - _MAX_NAMED} more" if len(means) > _MAX_NAMED else ""
    return f"Solved episodes on {first}: {', '.join(means[:_MAX_NAMED])}{more}."


def duration(seconds: float) -> str:
    """Write a time with a fitting unit.

    Example:
        >>> duration(95), duration(7300)
        ('1.6 min', '2.0 h')
    """
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"
