"""Input ablations of each policy, for the report."""

from dataclasses import dataclass

from openvima.evaluation.comparison import ABLATION_SEPARATOR, can_be_compared, compare_pairs
from openvima.evaluation.results import Results
from openvima.report.text import points, points_span

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
