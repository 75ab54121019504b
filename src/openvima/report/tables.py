"""Contents of the report's tables."""

from collections import Counter
from typing import NamedTuple

from openvima.evaluation.results import Results
from openvima.evaluation.statistics import Interval, mean_of_rates
from openvima.report.text import counted

_MOST_TASKS = 4  # that are named for a cause of failure
_MOST_CAUSES = 8  # listed for a policy


class FailureCause(NamedTuple):
    """A cause of failed episodes, with its fraction of all episodes and the tasks with the most."""

    kind: str
    episodes: int
    fraction: float
    tasks: str


def failure_causes(results: Results, policy: str) -> list[FailureCause]:
    """Count why a policy did not solve episodes, most frequent causes first."""
    tasks: dict[str, Counter[str]] = {}
    rows = [row for row in results.rows if row.policy == policy and not row.ablation]
    for row in rows:
        for kind, count in row.failures.items():
            tasks.setdefault(kind, Counter())[row.task] += count
    episodes = sum(row.episodes for row in rows)
    ranked = sorted(tasks.items(), key=lambda item: (-item[1].total(), item[0]))
    causes = [
        FailureCause(kind, counts.total(), counts.total() / episodes, _by_task(counts))
        for kind, counts in ranked[:_MOST_CAUSES]
    ]
    rare = ranked[_MOST_CAUSES:]
    if rare:
        count = sum(counts.total() for _, counts in rare)
        causes.append(FailureCause(counted(len(rare), "rarer cause"), count, count / episodes, ""))
    return causes


def oracle_horizon_means(results: Results, level: str) -> list[tuple[float, Interval] | None]:
    """Mean of each policy within the oracle's step limit; empty where it is that of the usual one."""
    means: list[tuple[float, Interval] | None] = []
    differs = False
    for policy in results.policy_names():
        rows = [r for r in results.rows if (r.policy, r.level, r.ablation) == (policy, level, "")]
        counts = [(row.successes_oracle_horizon, row.episodes) for row in rows]
        means.append(mean_of_rates(counts) if rows else None)
        differs = differs or any(row.successes_oracle_horizon < row.successes for row in rows)
    return means if differs else []


def _by_task(counts: Counter[str]) -> str:
    """The tasks with the most, and how many more there are."""
    ranked = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    named = ", ".join(f"{task} {count}" for task, count in ranked[:_MOST_TASKS])
    rest = len(ranked) - _MOST_TASKS
    return f"{named} and {counted(rest, 'other task')}" if rest > 0 else named
