"""Tables of the report: success by task, and why episodes were not solved."""

from collections import Counter
from collections.abc import Mapping

from openvima.evaluation.results import LevelMean, Results, Row
from openvima.evaluation.statistics import mean_of_rates
from openvima.html import breakable
from openvima.report.markup import policy_head, section
from openvima.report.published import BESIDE, published_tasks
from openvima.report.text import (
    LEVEL_NAMES,
    counted,
    exact,
    percent,
    prose,
    series_colours,
    span,
)

_MOST_TASKS = 4  # that are named for a cause of failure
_MOST_CAUSES = 8  # listed for a policy


def rate_table(results: Results) -> str:
    """Success of every policy on every task, by level, with 95 % intervals; published numbers beside."""
    policies, colours, means = results.policy_names(), series_colours(results), results.means()
    is_published = any(
        task in published_tasks(level) for level in results.levels() for task in results.tasks(level)
    )
    head = "".join(policy_head(policy, colours[policy]) for policy in policies)
    if is_published:
        head += f'<th scope="col" class="elsewhere">{" ".join(BESIDE)}<small>published elsewhere</small></th>'
    bodies = "".join(_level_rows(results, means, level, is_published) for level in results.levels())
    note = (
        '<p class="note">The last column was not measured here: <a href="#published">about it</a>.</p>'
        if is_published
        else ""
    )
    return section(
        "results",
        "Results by task",
        "Solved episodes (%), with 95 % intervals (%) and counts. Means weight all tasks of a level alike.",
        '<div class="card scroll"><table class="rates"><thead><tr><th scope="col">task</th>'
        f"{head}</tr></thead>{bodies}</table></div>{note}",
    )


def failure_table(results: Results) -> str:
    """Why episodes were not solved, by policy."""
    lines, colours = [], series_colours(results)
    for policy in results.policy_names():
        rows = [row for row in results.rows if row.policy == policy and not row.ablation]
        lines += _failure_lines(policy, colours[policy], rows)
    return section(
        "failures",
        "Failures",
        "Causes of failed episodes, over all levels.",
        '<div class="card scroll"><table><thead><tr><th scope="col">policy</th><th scope="col">cause</th>'
        '<th scope="col" class="num">episodes</th><th scope="col" class="num">fraction</th>'
        f'<th scope="col">tasks</th></tr></thead><tbody>{"".join(lines)}</tbody></table></div>',
    )


def rate_cell(row: Row | None) -> str:
    """A task's success rate with its interval and counts; a dash where there is none."""
    if row is None:
        return "<td>–</td>"
    return (
        f'<td class="rate" style="--share:{row.rate:.3f}"><b>{exact(row.rate)}</b>'
        f"<small>{span(row.interval)} · {row.successes}/{row.episodes}</small></td>"
    )


def mean_cell(mean: LevelMean | None, num_tasks: int) -> str:
    """A level's mean with its interval, and the number of tasks where it is not that of the level."""
    if mean is None:
        return "<td>–</td>"
    fewer = f" · {len(mean.tasks)} of {num_tasks} tasks" if len(mean.tasks) < num_tasks else ""
    return (
        f'<td class="rate" style="--share:{mean.mean:.3f}"><b>{percent(mean.mean, 1)}</b>'
        f"<small>{span(mean.interval)}{fewer}</small></td>"
    )


def _level_rows(
    results: Results, means: Mapping[tuple[str, str, str], LevelMean], level: str, is_published: bool
) -> str:
    policies, tasks = results.policy_names(), results.tasks(level)
    rows = [
        f'<tr class="level"><th scope="rowgroup">{prose(level)}</th>'
        f'<td colspan="{len(policies) + is_published}">{prose(LEVEL_NAMES.get(level, level))}</td></tr>'
    ]
    elsewhere = published_tasks(level)
    for task in tasks:
        cells = "".join(rate_cell(results.row(policy, task, level)) for policy in policies)
        if is_published:
            cells += _elsewhere_cell(elsewhere.get(task))
        rows.append(f'<tr><th scope="row">{prose(breakable(task))}</th>{cells}</tr>')
    cells = "".join(mean_cell(means.get((policy, "", level)), len(tasks)) for policy in policies)
    if is_published:
        known = [elsewhere[task] for task in tasks if task in elsewhere]
        cells += _elsewhere_cell(sum(known) / len(tasks) if len(known) == len(tasks) else None)
    rows.append(f'<tr class="mean"><th scope="row">mean of {len(tasks)}</th>{cells}</tr>')
    rows += _strict_row(results, level, is_published)
    return f"<tbody>{''.join(rows)}</tbody>"


def _strict_row(results: Results, level: str, is_published: bool) -> list[str]:
    """Means under the oracle's own step limit, where they differ from those under the usual one."""
    cells, differs = [], False
    for policy in results.policy_names():
        rows = [r for r in results.rows if (r.policy, r.level, r.ablation) == (policy, level, "")]
        if not rows:
            cells.append("<td>–</td>")
            continue
        mean, interval = mean_of_rates([(row.successes_oracle_horizon, row.episodes) for row in rows])
        differs = differs or any(row.successes_oracle_horizon < row.successes for row in rows)
        cells.append(f"<td>{percent(mean, 1)}<small>{span(interval)}</small></td>")
    if not differs:
        return []
    head = '<th scope="row">mean within the oracle’s steps<small>instead of two more</small></th>'
    beside = _elsewhere_cell(None) if is_published else ""
    return [f'<tr class="strict">{head}{"".join(cells)}{beside}</tr>']


def _elsewhere_cell(rate: float | None) -> str:
    return f'<td class="elsewhere">{"–" if rate is None else f"{rate:.1f} %"}</td>'


def _failure_lines(policy: str, colour: str, rows: list[Row]) -> list[str]:
    causes: Counter[str] = Counter()
    tasks: dict[str, Counter[str]] = {}
    for row in rows:
        for kind, count in row.failures.items():
            causes[kind] += count
            tasks.setdefault(kind, Counter())[row.task] += count
    total = sum(row.episodes for row in rows)
    name = f'<span class="dot" style="--series:var({colour})"></span>{prose(policy)}'
    if not causes:
        return [f'<tr><td class="name">{name}</td><td colspan="4">every episode was solved</td></tr>']
    ranked = sorted(causes.items(), key=lambda item: (-item[1], item[0]))
    lines = [
        f'<tr><td class="name">{name if index == 0 else ""}</td><td class="cause">{prose(kind)}</td>'
        f'<td class="num">{count}</td><td class="num">{percent(count / total, 1)}</td>'
        f'<td class="long">{prose(_by_task(tasks[kind]))}</td></tr>'
        for index, (kind, count) in enumerate(ranked[:_MOST_CAUSES])
    ]
    rare = ranked[_MOST_CAUSES:]
    if rare:
        count = sum(number for _, number in rare)
        lines.append(
            f'<tr><td></td><td class="cause">{counted(len(rare), "rarer cause")}</td>'
            f'<td class="num">{count}</td><td class="num">{percent(count / total, 1)}</td><td></td></tr>'
        )
    return lines


def _by_task(counts: Counter[str]) -> str:
    """The tasks with the most, and how many more there are."""
    ranked = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    named = ", ".join(f"{task} {count}" for task, count in ranked[:_MOST_TASKS])
    rest = len(ranked) - _MOST_TASKS
    return f"{named} and {counted(rest, 'other task')}" if rest > 0 else named
