"""Tables of an evaluation for papers."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from openvima.evaluation.comparison import ABLATION_SEPARATOR, Comparison, Difference
from openvima.evaluation.results import LevelMean, Results
from openvima.report.families import family_table
from openvima.report.level_drop import level_drop_table
from openvima.report.published import (
    is_comparable,
    leading_models,
    published_coverage,
    published_rows,
    unpublished_settings,
)
from openvima.report.published_tasks import published_task_table
from openvima.report.rate_curves import rate_table
from openvima.report.rated_ablations import rate_figures
from openvima.report.text import ablation_name, counted
from openvima.report.typesetting import Estimate, Line, Table

_Means = Mapping[tuple[str, str, str], LevelMean]  # by policy, ablation and level
_CONFIRMED = "Measured outcomes are confirmed by replaying the recorded actions; who acted is declared."
_UNCONFIRMED = "Outcomes are not confirmed by replay, as `openvima verify-results` does."
_NOISE_MARK = "≈"


def paper_tables(
    results: Results,
    comparisons: Sequence[Comparison] = (),
    *,
    published: bool = True,
    confirmed: bool = False,
) -> list[Table]:
    """Choose what a paper would print: means by level, family and task, ablations, differences.

    Args:
        results: The evaluation.
        comparisons: Policies to compare.
        published: Whether to add published level means of the same tasks, unless prompts or tasks differ.
        confirmed: Whether all outcomes were confirmed by replay, which captions then say.
    """
    means = results.means()
    published = published and is_comparable(results)
    by_policy = [_task_table(results, means, policy) for policy in results.policy_names()]
    with_ablations = [
        _ablation_table(results, means, policy)
        for policy in results.policy_names()
        if any(row.policy == policy and row.ablation for row in results.rows)
    ]
    chosen = [
        _mean_table(results, means, published=published),
        level_drop_table(results, published=published),
        family_table(results, published=published),
        *by_policy,
        published_task_table(results) if published else None,
        *with_ablations,
        *map(rate_table, rate_figures(results)),
        *map(_difference_table, comparisons),
    ]
    tables = [table for table in chosen if table and table.lines]
    if confirmed:
        return [replace(table, caption=f"{table.caption} {_CONFIRMED}") for table in tables]
    return [replace(tables[0], caption=f"{tables[0].caption} {_UNCONFIRMED}"), *tables[1:]]


def _mean_table(results: Results, means: _Means, *, published: bool) -> Table:
    levels = results.levels()
    lines = [
        Line(
            policy,
            tuple(_mean_cell(means.get((policy, "", level)), len(results.tasks(level))) for level in levels),
        )
        for policy in results.policy_names()
    ]
    sizes = ", ".join(f"{len(results.tasks(level))} at {level}" for level in levels)
    caption = (
        f"Success rates (%), means over the tasks of each level ({sizes}), with 95 % intervals. "
        f"{_made_of(results)}"
    )
    elsewhere = published_rows(results, leading_models(), keep_marks=False) if published else []
    if elsewhere:
        for number, (name, cells) in enumerate(elsewhere):
            lines.append(Line(f"{name} (published)", cells, starts_group=number == 0))
        caption += (
            " Rows marked “published” were not measured here: they are those of the VIMA and MIDAS papers, "
            f"in another simulator. {published_coverage(results)} Means over all tasks of a level are mostly "
            "read off figures, to about 0.2 points, those with ~ to about 0.5."
        )
    return Table("levels", caption, ("policy", *levels), tuple(lines))


def _task_table(results: Results, means: _Means, policy: str) -> Table:
    levels = [level for level in results.levels() if any(r.level == level for r in _plain(results, policy))]
    tasks = list(dict.fromkeys(row.task for row in _plain(results, policy)))
    lines = []
    for task in tasks:
        rows = [results.row(policy, task, level) for level in levels]
        lines.append(Line(task, tuple(Estimate(row.rate, row.interval) if row else "–" for row in rows)))
    cells = tuple(_mean_cell(means.get((policy, "", level)), 0) for level in levels)
    lines.append(Line("mean", cells, starts_group=True))
    caption = f"Success rates of {policy} (%), with 95 % intervals. {_made_of(results, policy)}"
    return Table(f"tasks-{policy}", caption, ("task", *levels), tuple(lines))


def _ablation_table(results: Results, means: _Means, policy: str) -> Table:
    levels = results.levels()
    ablations = dict.fromkeys(row.ablation for row in results.rows if row.policy == policy)
    lines = [
        Line(
            ablation_name(ablation) if ablation else "none",
            tuple(
                _mean_cell(means.get((policy, ablation, level)), len(results.tasks(level)))
                for level in levels
            ),
        )
        for ablation in ablations
    ]
    caption = (
        f"Success rates of {policy} (%) with input ablations, means over the tasks of each level, with "
        "95 % intervals."
    )
    return Table(f"input-ablations-{policy}", caption, ("ablation", *levels), tuple(lines))


def _difference_table(comparison: Comparison) -> Table:
    first = comparison.levels[0]
    lines = [
        _difference_line(difference, starts_group=difference is first)
        for difference in (*comparison.tasks, *comparison.means)
    ]
    a, b = (name.replace(ABLATION_SEPARATOR, ", ") for name in (comparison.a, comparison.b))
    caption = (
        f"Success rate of {a} minus that of {b} on the same episodes, in percentage points, with 95 % "
        "intervals; episodes solved by one of them only; exact McNemar test, p as it is and after Holm for "
        f"the number of such tests in all comparisons made. {_NOISE_MARK}: not significant, the "
        "interval contains 0."
    )
    columns = ("task", "level", "difference", "one only", "p", "p (Holm)")
    return Table(f"difference-{a}-{b}".replace(", ", "-"), caption, columns, tuple(lines))


def _difference_line(difference: Difference, *, starts_group: bool) -> Line:
    mark = _NOISE_MARK if difference.verdict == "noise" else ""
    cells = (
        difference.level or "all",
        Estimate(difference.difference, difference.interval, signed=True, mark=mark),
        f"{difference.only_a} : {difference.only_b}",
        f"{difference.p_value:.2g}",
        f"{difference.p_holm:.2g}",
    )
    return Line(difference.task or f"mean of {len(difference.pairs)}", cells, starts_group)


def _plain(results: Results, policy: str) -> list:
    return [row for row in results.rows if (row.policy, row.ablation) == (policy, "")]


def _mean_cell(mean: LevelMean | None, num_tasks: int) -> Estimate | str:
    """A mean, with the number of its tasks where it is not that of the level."""
    if mean is None:
        return "–"
    fewer = f"{len(mean.tasks)} of {num_tasks} tasks" if len(mean.tasks) < num_tasks else ""
    return Estimate(mean.mean, mean.interval, mark=fewer)


def _made_of(results: Results, policy: str | None = None) -> str:
    """Say how many episodes a number is made of."""
    rows = [row for row in results.rows if not row.ablation and policy in (None, row.policy)]
    episodes = sorted({row.episodes for row in rows})
    number = f"{episodes[0]:,} to " * (len(episodes) > 1) + counted(episodes[-1], "episode")
    return f"{number} a task.{unpublished_settings(results)}"
