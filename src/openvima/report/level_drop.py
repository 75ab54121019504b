"""How much success is lost from the first to the last evaluated level, such as from L1 to L4."""

from openvima.evaluation.results import LevelMean, Results
from openvima.evaluation.statistics import difference_of_means, ratio_of_means
from openvima.report.published import leading_models, published_rate
from openvima.report.rate_curves import RateCurve, RateFigure, RatePanel, RatePoint
from openvima.report.typesetting import Estimate, Line, Table


def compared_levels(results: Results) -> list[str]:
    """Evaluated levels of L1 to L4, in this order."""
    return sorted(level for level in results.levels() if level != "train")


def level_drop_table(results: Results, *, published: bool = True) -> Table | None:
    """Change of each policy from the first to the last level, then that of published models.

    The tasks of two levels differ, so their means count as independent.

    Args:
        results: The evaluation.
        published: Whether to add published models that have numbers for the same tasks.

    Returns:
        The table; None for fewer than two levels.
    """
    levels = compared_levels(results)
    if len(levels) < 2:
        return None
    first, last = levels[0], levels[-1]
    means = results.means()
    lines = [
        Line(policy, _cells(means[policy, "", first], means[policy, "", last]))
        for policy in results.policy_names()
        if {(policy, "", first), (policy, "", last)} <= means.keys()
    ]
    elsewhere = _published_lines(results, first, last) if published else []
    caption = (
        f"Change of the mean success rate from {first} to {last}: in percentage points, and relative to "
        f"{first} (%), with 95 % intervals. The tasks of the two levels differ, so the means are treated as "
        "independent. A relative change has no bounded interval where the first mean is close to 0."
    )
    columns = ("policy", first, last, "change (points)", "relative change (%)")
    return Table("level-drop", caption, columns, (*lines, *elsewhere))


def level_figure(results: Results, *, published: bool = True) -> RateFigure | None:
    """Success rate of each policy over the levels; None for fewer than two levels."""
    levels = compared_levels(results)
    if len(levels) < 2:
        return None
    at = {level: float(index) for index, level in enumerate(levels)}
    own: dict[str, list[RatePoint]] = {}
    for mean in results.level_means():
        if mean.level in at and not mean.ablation:
            own.setdefault(mean.policy, []).append(RatePoint(at[mean.level], mean.mean, mean.interval))
    curves = [RateCurve(name, tuple(points)) for name, points in own.items()]
    for model in leading_models() if published else ():
        rates = {level: published_rate(level, results.tasks(level), model) for level in levels}
        known = tuple(RatePoint(at[level], r / 100) for level, r in rates.items() if r is not None)
        if len(known) > 1:
            curves.append(RateCurve(model.name, known, published=True))
    panel = RatePanel("Mean success", tuple(curves))
    ticks = {x: level for level, x in at.items()}
    return RateFigure("level-means", "Success rates over the levels.", "level", (panel,), ticks)


def _cells(first: LevelMean, last: LevelMean) -> tuple[Estimate | str, ...]:
    a, b = (last.mean, last.interval), (first.mean, first.interval)
    change = Estimate(*difference_of_means(a, b), signed=True)
    ratio = ratio_of_means(a, b)
    relative = "–" if ratio is None else Estimate(ratio[0] - 1, _less_one(ratio[1]), signed=True)
    return Estimate(*b), Estimate(*a), change, relative


def _less_one(interval: tuple[float, float]) -> tuple[float, float]:
    return interval[0] - 1, interval[1] - 1


def _published_lines(results: Results, first: str, last: str) -> list[Line]:
    lines: list[Line] = []
    for model in leading_models():
        a, b = (published_rate(level, results.tasks(level), model) for level in (first, last))
        if a and b is not None:
            written = f"{a:.1f}", f"{b:.1f}", f"{b - a:+.1f}", f"{100 * (b / a - 1):+.1f}"
            cells = tuple(text.replace("-", "−") for text in written)
            lines.append(Line(f"{model.name} (published)", cells, starts_group=not lines))
    return lines
