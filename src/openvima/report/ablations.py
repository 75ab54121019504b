"""Input ablations of each policy, for the report."""

from collections.abc import Iterator
from dataclasses import dataclass

from openvima.errors import ConfigError
from openvima.evaluation.ablations import ablation_parts
from openvima.evaluation.comparison import ABLATION_SEPARATOR, can_be_compared, compare_pairs
from openvima.evaluation.results import Results, Row
from openvima.evaluation.statistics import mean_of_rates
from openvima.report.figures import RateCurve, RateFigure, RatePanel, RatePoint
from openvima.report.text import ablation_name, counted, points, points_span

_BOUNDS = ("oracle", "random")  # kinds of policies that bound a score


@dataclass(frozen=True, slots=True)
class AblatedPolicy:
    """A policy that was evaluated with input ablations.

    Args:
        policy: Its name.
        ablations: Names of its ablations.
        columns: Policy and ablation of each column: its plain score, its ablations, bounds of the score.
        changes: By how much an ablation changes the mean of a level, in points with interval; ≈ marks noise.
    """

    policy: str
    ablations: tuple[str, ...]
    columns: tuple[tuple[str, str], ...]
    changes: dict[tuple[str, str], str]


def ablated_policies(results: Results) -> list[AblatedPolicy]:
    """Collect the policies with ablations."""
    ablations: dict[str, dict[str, None]] = {}
    for row in results.rows:
        if row.ablation:
            ablations.setdefault(row.policy, {})[row.ablation] = None
    return [
        _ablated(results, policy, tuple(ablations[policy]))
        for policy in results.policy_names()
        if policy in ablations
    ]


def _ablated(results: Results, policy: str, ablations: tuple[str, ...]) -> AblatedPolicy:
    bounds = [
        (name, "")
        for name in results.policy_names()
        if name != policy and results.policies.get(name, {}).get("kind") in _BOUNDS
    ]
    columns = ((policy, ""), *((policy, ablation) for ablation in ablations), *bounds)
    return AblatedPolicy(policy, ablations, columns, _changes(results, policy, ablations))


def _changes(results: Results, policy: str, ablations: tuple[str, ...]) -> dict[tuple[str, str], str]:
    names = {ablation: f"{policy}{ABLATION_SEPARATOR}{ablation}" for ablation in ablations}
    pairs = {a: (name, policy) for a, name in names.items() if can_be_compared(results, name, policy)}
    return {
        (ablation, change.level): f"{points(change.difference, 0)} ({points_span(change.interval, 0)})"
        + (" ≈" if change.verdict == "noise" else "")
        for ablation, comparison in zip(pairs, compare_pairs(results, list(pairs.values())), strict=True)
        for change in comparison.levels
    }


_DEFAULTS = ("num_distractors",)  # of which a task has a number of its own without the ablation
_UNITS = {"noisy_boxes": " (pixels)"}


def rate_figures(results: Results) -> list[RateFigure]:
    """Draw the rated ablations: a figure an ablation, a panel a level, a curve a policy.

    All points of a panel are means over the same tasks: those that were evaluated at every rate. The score
    without ablation is at rate 0, or apart as "default" for a number that each task sets by itself.
    """
    rows: dict[str, dict[str, dict[float, list[Row]]]] = {}
    for row in results.rows:
        name, rate = rated(row.ablation)
        if rate is not None:
            rows.setdefault(name, {}).setdefault(row.level, {}).setdefault(rate, []).append(row)
    return [_figure(results, name, by_level) for name, by_level in rows.items()]


def rated(ablation: str) -> tuple[str, float | None]:
    """Split an ablation into name and rate; the rate is None for one without, several, or no ablation.

    Example:
        >>> rated("masked_words:0.2"), rated("no_prompt")
        (('masked_words', 0.2), ('no_prompt', None))
    """
    try:
        (part,) = ablation_parts(ablation)
    except (ConfigError, ValueError):  # no ablation of this version, or not a single one
        return ablation, None
    return part.ablation.name, part.rate if part.ablation.rate else None


def _figure(results: Results, name: str, levels: dict[str, dict[float, list[Row]]]) -> RateFigure:
    is_apart = name in _DEFAULTS
    plain = min(rate for rates in levels.values() for rate in rates) - 1 if is_apart else 0.0
    panels = tuple(_panels(results, levels, plain, is_apart))
    caption = f"Success rates with the input ablation “{ablation_name(name)}”."
    quantity = ablation_name(name) + _UNITS.get(name, "")
    ticks = {plain: "default"} if is_apart else {}
    return RateFigure(f"rate-{name.replace('_', '-')}", caption, quantity, panels, ticks)


def _panels(
    results: Results, levels: dict[str, dict[float, list[Row]]], plain: float, is_apart: bool
) -> Iterator[RatePanel]:
    for level, rates in levels.items():
        policies = list(dict.fromkeys(row.policy for rows in rates.values() for row in rows))
        played = [
            {row.task for row in rows if row.policy == policy}
            for rows in rates.values()
            for policy in policies
        ]
        tasks = set.intersection(*(found for found in played if found))
        if not tasks:
            continue
        curves = []
        for policy in policies:
            unchanged = [row for task in sorted(tasks) if (row := results.row(policy, task, level))]
            by_rate = {rate: [row for row in rows if row.policy == policy] for rate, rows in rates.items()}
            measured = {plain: unchanged, **by_rate} if len(unchanged) == len(tasks) else by_rate
            points = [_point(rate, rows, tasks) for rate, rows in sorted(measured.items()) if rows]
            apart = is_apart and points[0].x == plain
            curves += [
                RateCurve(policy, tuple(part)) for part in ([points[:1], points[1:]] if apart else [points])
            ]
        yield RatePanel(f"{level} ({counted(len(tasks), 'task')})", tuple(curves))


def _point(rate: float, rows: list[Row], tasks: set[str]) -> RatePoint:
    counts = [(row.successes, row.episodes) for row in rows if row.task in tasks]
    return RatePoint(rate, *mean_of_rates(counts))
