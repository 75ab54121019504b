"""The tables of an evaluation: means by level, family and task, ablations, differences, failures."""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from openvima.errors import UnknownTaskError
from openvima.evaluation.comparison import ABLATION_SEPARATOR, Comparison, Difference
from openvima.evaluation.results import Results, group_by_key
from openvima.evaluation.statistics import mean_of_rates
from openvima.report.published import (
    BESIDE,
    BY_TASK,
    has_published_tasks,
    is_comparable,
    leading_models,
    models_by_task,
    published_rate,
    published_rows,
    unusual_settings,
)
from openvima.report.table import Estimate, Line, Table
from openvima.report.text import ablation_name, episodes_each
from openvima.tasks.registry import task_spec


def failure_causes(results: Results, policy: str) -> dict[str, Counter[str]]:
    """Count by task why a policy did not solve episodes, most frequent causes first."""
    tasks: dict[str, Counter[str]] = {}
    for row in results.rows:
        if row.policy == policy and not row.ablation:
            for kind, count in row.failures.items():
                tasks.setdefault(kind, Counter())[row.task] += count
    return dict(sorted(tasks.items(), key=lambda item: (-item[1].total(), item[0])))


FAMILIES = (  # in the paper's order
    "simple_object_manipulation",
    "visual_goal_reaching",
    "novel_concept_grounding",
    "one_shot_video_imitation",
    "visual_constraint_satisfaction",
    "visual_reasoning",
)


def family_table(results: Results, *, published: bool = True) -> Table:
    """Mean success rate of each policy over the tasks of each family, level by level.

    A task of several families counts in each of them; one that is not registered here in none.

    Args:
        results: The evaluation.
        published: Whether to add a column of the model whose rates by task were published.
    """
    policies = results.policy_names()
    lines = []
    for level in results.levels():
        for index, (family, tasks) in enumerate(_tasks(results, level).items()):
            cells = [_mean(results, policy, level, tasks=tasks) for policy in policies]
            rate = published_rate(level, tasks) if published else None
            elsewhere = ["–" if rate is None else f"{rate:.1f}"] if published else []
            name = family.replace("_", " ").replace("one shot", "one-shot")
            lines.append(
                Line(
                    f"{name} ({len(tasks)})",
                    (level, *cells, *elsewhere),
                    starts_group=index == 0 and bool(lines),
                )
            )
    caption = (
        "Success rates (%) by task family, means over the tasks of each family (their number in brackets), "
        "with 95 % intervals. A task of several families counts in each."
    )
    elsewhere = (f"{BESIDE} (published)",) if published else ()
    return Table("families", caption, ("family", "level", *policies, *elsewhere), tuple(lines))


def _tasks(results: Results, level: str) -> dict[str, list[str]]:
    """Evaluated tasks of each family at a level."""
    found: dict[str, list[str]] = {family: [] for family in FAMILIES}
    for task in results.tasks(level):
        with suppress(UnknownTaskError):  # not registered here
            for family in task_spec(task).families:
                found.setdefault(family, []).append(task)
    return {family: tasks for family, tasks in found.items() if tasks}


def _mean(
    results: Results, policy: str, level: str, ablation: str = "", *, tasks: Sequence[str] = ()
) -> Estimate | str:
    """Mean over tasks, by default all of the level; with their number where some are lacking."""
    tasks = tasks or results.tasks(level)
    rows = [row for task in tasks if (row := results.row(policy, task, level, ablation))]
    if not rows:
        return "–"
    mean, interval = mean_of_rates([(row.successes, row.episodes) for row in rows])
    fewer = f"{len(rows)} of {len(tasks)} tasks" if len(rows) < len(tasks) else ""
    return Estimate(mean, interval, mark=fewer)


_CONFIRMED = "Measured outcomes are confirmed by replaying the recorded actions; who acted is declared."
_UNCONFIRMED = "Outcomes are not confirmed by replay, as `openvima verify-results` does."
_NOISE_MARK, _WEAK_MARK = "≈", "?"


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
    published = published and is_comparable(results)
    chosen = [
        _mean_table(results, published=published),
        family_table(results, published=published),
        *[_task_table(results, policy) for policy in results.policy_names()],
        *([result_table(results, published=True)] if has_published_tasks(results) and published else []),
        *ablation_tables(results),
        *map(_difference_table, comparisons),
    ]
    tables = [table for table in chosen if table.lines]
    if confirmed:
        return [replace(table, caption=f"{table.caption} {_CONFIRMED}") for table in tables]
    return [replace(tables[0], caption=f"{tables[0].caption} {_UNCONFIRMED}"), *tables[1:]]


def _mean_table(results: Results, *, published: bool) -> Table:
    levels = results.levels()
    lines = [
        Line(policy, tuple(_mean(results, policy, level) for level in levels))
        for policy in results.policy_names()
    ]
    sizes = ", ".join(f"{len(results.tasks(level))} at {level}" for level in levels)
    caption = (
        f"Success rates (%), means over the tasks of each level ({sizes}), with 95 % intervals. "
        f"{_made_of(results)}"
    )
    elsewhere = published_rows(results, leading_models()) if published else []
    if elsewhere:
        for number, (name, cells) in enumerate(elsewhere):
            lines.append(Line(f"{name} (published)", cells, starts_group=number == 0))
        caption += (
            " Rows marked “published” were not measured here: they are those of the VIMA and MIDAS papers, "
            "in another simulator, over the same tasks. Means over all tasks of a level are mostly read off "
            "figures, to about 0.2 points, those with ~ to about 0.5, or printed by the authors (*)."
        )
    return Table("levels", caption, ("policy", *levels), tuple(lines))


def result_table(results: Results, *, published: bool = False) -> Table:
    """Success rates of all policies by level and task, with the mean of each level.

    Args:
        results: The evaluation.
        published: Whether to add the published rates by task.
    """
    policies, models = results.policy_names(), models_by_task(results) if published else []
    lines: list[Line] = []
    for level in results.levels():
        tasks = results.tasks(level)
        for task in tasks:
            own = [_mean(results, policy, level, tasks=(task,)) for policy in policies]
            elsewhere = [model.written_task(level, task) for model in models]
            starts = bool(lines) and task == tasks[0]
            lines.append(Line(task, (level, *own, *elsewhere), starts_group=starts))
        means = (_mean(results, policy, level) for policy in policies)
        lines.append(Line("mean", (level, *means, *["–"] * len(models))))
    control = f", control {results.config['control']}" if "control" in results.config else ""
    about = f". {BY_TASK}" if published else ""
    columns = ("task", "level", *policies, *(f"{each.model} {each.size} (published)" for each in models))
    return Table("results", f"Success rates (%), with 95 % intervals{control}{about}", columns, tuple(lines))


def ablations_by_policy(results: Results) -> dict[str, list[str]]:
    """Return the input ablations that each policy was evaluated with; without any it is left out."""
    return group_by_key(dict.fromkeys((row.policy, row.ablation) for row in results.rows if row.ablation))


def ablation_tables(results: Results) -> list[Table]:
    """Level means of each policy that was evaluated with input ablations, plain and under each of them."""
    levels, tables = results.levels(), []
    for policy, ablations in ablations_by_policy(results).items():
        lines = [
            Line(
                ablation_name(ablation) if ablation else "none",
                tuple(_mean(results, policy, level, ablation) for level in levels),
            )
            for ablation in ("", *ablations)
        ]
        caption = (
            f"Success rates of {policy} (%) with input ablations, means over the tasks of each level, with "
            "95 % intervals."
        )
        columns = ("ablation", *levels)
        tables.append(Table(f"input-ablations-{policy}", caption, columns, tuple(lines)))
    return tables


def _task_table(results: Results, policy: str) -> Table:
    own = replace(
        results, rows=tuple(row for row in results.rows if (row.policy, row.ablation) == (policy, ""))
    )
    levels = own.levels()
    lines = [
        Line(task, tuple(_mean(own, policy, level, tasks=(task,)) for level in levels))
        for task in own.tasks()
    ]
    means = tuple(_mean(own, policy, level) for level in levels)
    lines.append(Line("mean", means, starts_group=True))
    caption = f"Success rates of {policy} (%), with 95 % intervals. {_made_of(results, policy)}"
    return Table(f"tasks-{policy}", caption, ("task", *levels), tuple(lines))


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
        f"interval contains 0. {_WEAK_MARK}: weak, it does not, but p (Holm) is at least 0.05."
    )
    columns = ("task", "level", "difference", "one only", "p", "p (Holm)")
    return Table(f"difference-{a}-{b}".replace(", ", "-"), caption, columns, tuple(lines))


def _difference_line(difference: Difference, *, starts_group: bool) -> Line:
    mark = {"noise": _NOISE_MARK, "unsure": _WEAK_MARK}.get(difference.verdict, "")
    cells = (
        difference.level or "all",
        Estimate(difference.difference, difference.interval, signed=True, mark=mark),
        f"{difference.total.only_a} : {difference.total.only_b}",
        f"{difference.p_value:.2g}",
        f"{difference.p_holm:.2g}",
    )
    return Line(difference.task or f"mean of {len(difference.pairs)}", cells, starts_group)


def _made_of(results: Results, policy: str | None = None) -> str:
    """Say how many episodes a number is made of."""
    rows = [row for row in results.rows if not row.ablation and policy in (None, row.policy)]
    return f"{episodes_each(rows)} a task.{unusual_settings(results)}"
