"""Merging several evaluations, for a common report and for comparisons."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations

from openvima.catalog.partitions import LEVELS
from openvima.env.config import DEFAULT_ENV_CONFIG
from openvima.errors import ConfigError
from openvima.evaluation.results import EpisodeOutcome, Results, Row

# Settings that decide which episode a seed stands for, with what holds for files that do not name them.
_SAME_EPISODES = {"domain": "eval", **asdict(DEFAULT_ENV_CONFIG)}


@dataclass(frozen=True, slots=True)
class Merged:
    """Several evaluations joined.

    Args:
        results: All rows. Different policies of the same name are told apart by their evaluation, as
            "mine@first".
        names: For each evaluation the new names of its policies.
        notes: Warnings about differences between the evaluations.
    """

    results: Results
    names: Mapping[str, Mapping[str, str]]
    notes: tuple[str, ...] = ()


def merge(evaluations: Mapping[str, Results]) -> Merged:
    """Join evaluations.

    Rows of the same policy are joined: it has the same name and weights, and no episode ended differently.

    Args:
        evaluations: Name of each evaluation, such as that of its folder, to its results.

    Returns:
        The joined results, with the new names.

    Raises:
        ConfigError: A seed does not stand for the same episode in all of them.
    """
    if len(evaluations) == 1:
        (label, results), *_ = evaluations.items()
        return Merged(results, {label: {name: name for name in results.policy_names()}})
    _check_same_episodes(evaluations)
    names = _names(evaluations)
    found = list(evaluations.values())
    policies = {
        names[label][name]: record
        for label, results in evaluations.items()
        for name, record in results.policies.items()
        if name in names[label]
    }
    config = {key: value for key, value in found[0].config.items() if key in _SAME_EPISODES}
    versions, notes = _versions(found)
    return Merged(Results(_rows(evaluations, names), config, versions, policies), names, notes)


def _check_same_episodes(evaluations: Mapping[str, Results]) -> None:
    for key, usual in _SAME_EPISODES.items():
        values = {label: results.config.get(key, usual) for label, results in evaluations.items()}
        if len({str(value) for value in values.values()}) > 1:
            listed = ", ".join(f"{value} in {label}" for label, value in values.items())
            why = "steps differ" if key == "control" else "a seed is not the same episode"
            raise ConfigError(
                f"these results cannot stand side by side: {key} is {listed}, so {why}. "
                "Make one report of each."
            )


def _names(evaluations: Mapping[str, Results]) -> dict[str, dict[str, str]]:
    """Give policies of different evaluations different names, unless they are the same policy."""
    names: dict[str, dict[str, str]] = {label: {} for label in evaluations}
    for policy in dict.fromkeys(name for results in evaluations.values() for name in results.policy_names()):
        holders = {label: found for label, found in evaluations.items() if policy in found.policy_names()}
        same = all(_is_same(policy, one, other) for one, other in combinations(holders.values(), 2))
        for label in holders:
            names[label][policy] = policy if same else f"{policy}@{label}"
    return names


def _is_same(policy: str, one: Results, other: Results) -> bool:
    """Whether two evaluations can have scored the same policy: equal weights, and no contradiction."""
    if one.policies.get(policy) != other.policies.get(policy):
        return False
    known = _outcomes(policy, one)
    return all(known.get(key, outcome) == outcome for key, outcome in _outcomes(policy, other).items())


def _outcomes(policy: str, results: Results) -> dict[tuple[str, str, str, int], tuple[bool, int]]:
    return {
        (row.task, row.level, row.ablation, outcome.seed): (outcome.success, outcome.steps)
        for row in results.rows
        if row.policy == policy
        for outcome in row.outcomes
    }


def _rows(evaluations: Mapping[str, Results], names: Mapping[str, Mapping[str, str]]) -> tuple[Row, ...]:
    """All rows under their new names, in the order policy, ablation, level, task."""
    joined: dict[tuple[str, str, str, str], Row] = {}
    for label, results in evaluations.items():
        for row in results.rows:
            row = replace(row, policy=names[label][row.policy])
            key = (row.policy, row.ablation, row.level, row.task)
            joined[key] = _joined(joined[key], row) if key in joined else row
    policies = list(dict.fromkeys(row.policy for row in joined.values()))
    ablations = list(dict.fromkeys(row.ablation for row in joined.values()))
    tasks = list(dict.fromkeys(row.task for row in joined.values()))

    def place(row: Row) -> tuple[int, ...]:
        level = LEVELS.index(row.level) if row.level in LEVELS else len(LEVELS)
        return policies.index(row.policy), ablations.index(row.ablation), level, tasks.index(row.task)

    return tuple(sorted(joined.values(), key=place))


def _joined(one: Row, other: Row) -> Row:
    outcomes: dict[int, EpisodeOutcome] = {o.seed: o for o in (*one.outcomes, *other.outcomes)}
    return replace(one, outcomes=tuple(outcomes[seed] for seed in sorted(outcomes)))


def _versions(found: Sequence[Results]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Versions of all evaluations, and a note if they differ."""
    packages = dict.fromkeys(package for results in found for package in results.versions)
    versions = {
        package: " / ".join(dict.fromkeys(r.versions[package] for r in found if package in r.versions))
        for package in packages
    }
    differing = [f"{package} {text}" for package, text in versions.items() if " / " in text]
    if not differing:
        return versions, ()
    note = (
        f"These evaluations ran with different versions ({', '.join(differing)}); the same seed may then be "
        "a slightly different episode."
    )
    return versions, (note,)
