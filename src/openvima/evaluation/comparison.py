"""Evaluations side by side: merging several, and paired comparison of policies on the same seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from typing import Literal

from openvima.catalog.partitions import LEVELS
from openvima.env.config import DEFAULT_ENV_CONFIG
from openvima.errors import ConfigError, UnknownPolicyError, brief_repr, unknown_name
from openvima.evaluation.ablations import scenes_of
from openvima.evaluation.results import Results, Row, group_by_key
from openvima.evaluation.sources import TRAINED_KINDS
from openvima.evaluation.statistics import Interval, PairCounts, holm, mcnemar, mean_difference

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
        same = _is_same(policy, list(holders.values()))
        for label in holders:
            names[label][policy] = policy if same else f"{policy}@{label}"
    return names


def _is_same(policy: str, evaluations: Sequence[Results]) -> bool:
    """Whether evaluations can have scored the same policy: equal weights, and no contradiction."""
    first = evaluations[0].policies.get(policy)
    known: dict[tuple[str, str, str, int], tuple[bool, int]] = {}
    return all(results.policies.get(policy) == first for results in evaluations) and all(
        known.setdefault((row.task, row.level, row.ablation, o.seed), (o.success, o.steps))
        == (o.success, o.steps)
        for results in evaluations
        for row in results.rows
        if row.policy == policy
        for o in row.outcomes
    )


def _rows(evaluations: Mapping[str, Results], names: Mapping[str, Mapping[str, str]]) -> tuple[Row, ...]:
    """All rows under their new names, in the order policy, ablation, level, task."""
    cells = group_by_key(
        ((names[label][row.policy], row.ablation, row.level, row.task), row)
        for label, results in evaluations.items()
        for row in results.rows
    )
    joined = [_join_rows(policy, rows) for (policy, *_), rows in cells.items()]
    policies = list(dict.fromkeys(row.policy for row in joined))
    ablations = list(dict.fromkeys(row.ablation for row in joined))

    def place(row: Row) -> tuple[int, ...]:
        level = LEVELS.index(row.level) if row.level in LEVELS else len(LEVELS)
        return policies.index(row.policy), ablations.index(row.ablation), level

    return tuple(sorted(joined, key=place))


def _join_rows(policy: str, rows: Sequence[Row]) -> Row:
    outcomes = {outcome.seed: outcome for row in rows for outcome in row.outcomes}
    return replace(rows[0], policy=policy, outcomes=tuple(outcomes[seed] for seed in sorted(outcomes)))


def _versions(found: Sequence[Results]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Versions of all evaluations, and a note if they differ."""
    all_versions = group_by_key(item for results in found for item in results.versions.items())
    versions = {package: " / ".join(dict.fromkeys(each)) for package, each in all_versions.items()}
    differing = [f"{package} {text}" for package, text in versions.items() if " / " in text]
    if not differing:
        return versions, ()
    note = (
        f"These evaluations ran with different versions ({', '.join(differing)}); the same seed may then be "
        "a slightly different episode."
    )
    return versions, (note,)


Verdict = Literal["a", "b", "unsure", "noise"]
Rows = Mapping[tuple[str, str], Row]  # by level and task
ABLATION_SEPARATOR = ":"  # "mine:no_prompt" is the policy `mine` under the ablation `no_prompt`
_FALSE_ALARMS = 0.05
_MOST_PAIRS = 6  # that are compared unasked


@dataclass(frozen=True, slots=True)
class Difference:
    """How much more often one policy solves the same episodes than another.

    Args:
        level: The level; empty for the mean over all levels.
        task: The task; empty for a mean over tasks.
        pairs: Outcomes of each task and level that it is made of.
        rate_a: Success rate of the first policy, for a mean unweighted over tasks.
        rate_b: That of the second one.
        difference: The first minus the second, as a fraction.
        interval: Its 95 % interval, see `statistics.mean_difference`.
        p_value: Exact McNemar test, two-sided; over several tasks that of the added counts.
        p_mid: The same test with the observed outcome counted half.
        p_holm: `p_value`, adjusted by Holm's method for all differences of its kind that were looked at.
    """

    level: str
    task: str
    pairs: tuple[PairCounts, ...]
    rate_a: float
    rate_b: float
    difference: float
    interval: Interval
    p_value: float
    p_mid: float
    p_holm: float

    @property
    def total(self) -> PairCounts:
        """Outcomes of all its tasks and levels."""
        return PairCounts.sum(self.pairs)

    @property
    def verdict(self) -> Verdict:
        """Which policy is better.

        Returns:
            "noise" where the interval holds 0, so that chance alone explains the difference; "unsure" where
            it does not, but the test does not hold out against the number of comparisons; else "a" or "b".
        """
        if self.interval[0] <= 0 <= self.interval[1]:
            return "noise"
        if self.p_holm >= _FALSE_ALARMS:
            return "unsure"
        return "a" if self.difference > 0 else "b"

    def record(self) -> dict[str, object]:
        """Everything as plain JSON values."""
        return {
            "level": self.level or "all",
            "task": self.task or "mean",
            "episodes": self.total.episodes,
            "rates": [round(self.rate_a, 6), round(self.rate_b, 6)],
            "difference": round(self.difference, 6),
            "interval": [round(end, 6) for end in self.interval],
            "only_a": self.total.only_a,
            "only_b": self.total.only_b,
            "p_mcnemar": self.p_value,
            "p_mcnemar_mid": self.p_mid,
            "p_holm": self.p_holm,
            "verdict": self.verdict,
        }


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two policies on their common episodes.

    Args:
        a: Name of the first policy, with its ablation if any, as in "mine:no_prompt".
        b: Name of the second one.
        tasks: Differences on single tasks, in the order level, task.
        levels: Mean over the tasks of each level.
        overall: Mean over all tasks of all levels; the same as `levels[0]` where there is but one.
        unpaired: Episodes of only one of the two; they are left out.
    """

    a: str
    b: str
    tasks: tuple[Difference, ...]
    levels: tuple[Difference, ...]
    overall: Difference
    unpaired: int

    __repr__ = brief_repr

    @property
    def means(self) -> tuple[Difference, ...]:
        """The means of the levels, and that of all where there are several."""
        return (*self.levels, self.overall) if len(self.levels) > 1 else self.levels

    def record(self) -> dict[str, object]:
        """Everything as plain JSON values."""
        return {
            "a": self.a,
            "b": self.b,
            "unpaired": self.unpaired,
            "overall": self.overall.record(),
            "levels": [difference.record() for difference in self.levels],
            "tasks": [difference.record() for difference in self.tasks],
        }


def compare(results: Results, a: str, b: str) -> Comparison:
    """Compare two policies of an evaluation, seed by seed.

    Args:
        results: The evaluation; `merging.merge` joins several.
        a: A policy, or "POLICY:ABLATION" for its rows under that ablation.
        b: Another one.

    Returns:
        Differences a minus b by task, level and in all.

    Raises:
        UnknownPolicyError: The results hold no such policy or ablation.
        ConfigError: The two have no episode in common.
    """
    return compare_pairs(results, [(a, b)])[0]


def compare_pairs(results: Results, pairs: Sequence[tuple[str, str]]) -> list[Comparison]:
    """Compare several pairs of policies, with p-values adjusted for the number of pairs too."""
    return _adjusted([_compare(results, a, b) for a, b in pairs])


def default_pairs(results: Results) -> list[tuple[str, str]]:
    """What is worth comparing unasked: the first learned policy with all others but the oracle."""
    kinds = {name: results.policies.get(name, {}).get("kind", "run") for name in results.policy_names()}
    learned = [name for name, kind in kinds.items() if kind in TRAINED_KINDS]
    others = [name for name, kind in kinds.items() if name not in learned[:1] and kind != "oracle"]
    pairs = [(learned[0], other) for other in others] if learned else []
    return [pair for pair in pairs if _pairs(*(_rows_of(results, name) for name in pair))][:_MOST_PAIRS]


def _compare(results: Results, a: str, b: str) -> Comparison:
    rows_a, rows_b = _rows_of(results, a), _rows_of(results, b)
    pairs = _pairs(rows_a, rows_b)
    if not pairs:
        raise ConfigError(
            f"{a} and {b} have no episode in common; evaluate both on the same tasks, levels and seeds, with "
            "the same number of distractors."
        )
    cells = [_difference(*cell, (pair,)) for cell, pair in pairs.items()]
    levels = [
        _difference(level, "", tuple(cell.pairs[0] for cell in of_level))
        for level, of_level in groupby(cells, key=lambda cell: cell.level)
    ]
    overall = _difference("", "", tuple(pairs.values())) if len(levels) > 1 else levels[0]
    played = sum(row.episodes for row in (*rows_a.values(), *rows_b.values()))
    unpaired = played - 2 * PairCounts.sum(pairs.values()).episodes
    return Comparison(a, b, tuple(cells), tuple(levels), overall, unpaired)


def _rows_of(results: Results, name: str) -> Rows:
    """Rows of a policy, plain or under an ablation, by level and task, levels one after the other."""
    rows = group_by_key(
        (ABLATION_SEPARATOR.join(filter(None, (row.policy, row.ablation))), row) for row in results.rows
    )
    if name not in rows:
        raise UnknownPolicyError(unknown_name("policy", name, rows))
    order = results.levels()
    return {(row.level, row.task): row for row in sorted(rows[name], key=lambda row: order.index(row.level))}


def _pairs(rows_a: Rows, rows_b: Rows) -> dict[tuple[str, str], PairCounts]:
    """Count outcomes on the seeds that both policies played, by level and task."""
    pairs = {}
    for cell, a in rows_a.items():
        b = rows_b.get(cell)
        if b is None or scenes_of(a.ablation) != scenes_of(b.ablation):  # a seed is not the same episode
            continue
        solved_b = {outcome.seed: outcome.success for outcome in b.outcomes}
        outcomes = [(o.success, solved_b[o.seed]) for o in a.outcomes if o.seed in solved_b]
        if outcomes:
            pairs[cell] = PairCounts.of(outcomes)
    return pairs


def _difference(level: str, task: str, pairs: tuple[PairCounts, ...]) -> Difference:
    difference, interval = mean_difference(pairs)
    total = PairCounts.sum(pairs)
    p_value, p_mid = mcnemar(total.only_a, total.only_b)
    rate_a = sum((pair.both + pair.only_a) / pair.episodes for pair in pairs) / len(pairs)
    rate_b = sum((pair.both + pair.only_b) / pair.episodes for pair in pairs) / len(pairs)
    return Difference(
        level, task, pairs, rate_a, rate_b, difference, interval, p_value, p_mid, p_holm=p_value
    )


def _adjusted(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Adjust p-values: those of tasks for the number of tasks and pairs, those of means for theirs."""
    of_tasks = iter(holm([task.p_value for comparison in comparisons for task in comparison.tasks]))
    of_levels = iter(holm([level.p_value for comparison in comparisons for level in comparison.levels]))
    of_all = holm([comparison.overall.p_value for comparison in comparisons])
    return [
        replace(
            comparison,
            tasks=tuple(replace(task, p_holm=next(of_tasks)) for task in comparison.tasks),
            levels=tuple(replace(level, p_holm=next(of_levels)) for level in comparison.levels),
            overall=replace(comparison.overall, p_holm=p_all),
        )
        for comparison, p_all in zip(comparisons, of_all, strict=True)
    ]
