"""Section of the report on input ablations."""

from collections.abc import Mapping

from openvima.evaluation.comparison import ABLATION_SEPARATOR, Comparison, can_be_compared, compare_pairs
from openvima.evaluation.results import LevelMean, Results
from openvima.report.markup import folded, policy_head, section
from openvima.report.tables import mean_cell, rate_cell
from openvima.report.text import (
    LEVEL_NAMES,
    ablation_description,
    ablation_name,
    points,
    points_span,
    prose,
    series_colours,
)

_BOUNDS = ("oracle", "random")  # kinds of policies that bound a score


def ablation_section(results: Results) -> str:
    """Scores with and without input ablations; empty if there are none."""
    policies = [policy for policy in results.policy_names() if _ablations(results, policy)]
    if not policies:
        return ""
    ablations = dict.fromkeys(ablation for policy in policies for ablation in _ablations(results, policy))
    meanings = "".join(
        f"<dt>{prose(ablation_name(ablation))}</dt><dd>{prose(ablation_description(ablation))}</dd>"
        for ablation in ablations
    )
    means = results.means()
    return section(
        "ablations",
        "Input ablations",
        "The same policy on the same episodes with one input removed or replaced. Below each score: its "
        "95 % interval and the change in points; ≈ marks changes inside the noise.",
        "".join(_policy(results, means, policy) for policy in policies)
        + f'<div class="card"><dl class="levels">{meanings}</dl></div>',
    )


def _ablations(results: Results, policy: str) -> list[str]:
    return list(dict.fromkeys(row.ablation for row in results.rows if row.policy == policy and row.ablation))


def _policy(results: Results, means: Mapping[tuple[str, str, str], LevelMean], policy: str) -> str:
    ablations = _ablations(results, policy)
    comparisons = _against_plain(results, policy, ablations)
    bounds = [
        name
        for name in results.policy_names()
        if name != policy and results.policies.get(name, {}).get("kind") in _BOUNDS
    ]
    colours = series_colours(results)
    columns = [
        (policy, ""),
        *((policy, ablation) for ablation in ablations),
        *((name, "") for name in bounds),
    ]
    head = "".join(
        f'<th scope="col">{prose(ablation_name(ablation))}</th>'
        if ablation
        else policy_head(name, colours[name])
        for name, ablation in columns
    )
    head = f'<thead><tr><th scope="col">level</th>{head}</tr></thead>'
    rows, details = "", ""
    for level in results.levels():
        cells = "".join(
            _with_drop(
                mean_cell(means.get((name, ablation, level)), len(results.tasks(level))),
                comparisons.get(ablation),
                level,
            )
            for name, ablation in columns
        )
        rows += (
            f'<tr><th scope="row">{prose(level)}<small>{prose(LEVEL_NAMES.get(level, ""))}</small></th>'
            f"{cells}</tr>"
        )
        details += _task_rows(results, level, columns)
    return (
        f'<h3 class="of">{prose(policy)}</h3>'
        f'<div class="card scroll"><table class="rates narrow">{head}<tbody>{rows}'
        "</tbody></table></div>"
        + folded(
            f"{policy}, task by task",
            f'<div class="scroll"><table class="rates narrow">{head}<tbody>{details}</tbody></table></div>',
        )
    )


def _against_plain(results: Results, policy: str, ablations: list[str]) -> dict[str, Comparison]:
    """Each ablation against the unablated score, on their common episodes."""
    names = {ablation: f"{policy}{ABLATION_SEPARATOR}{ablation}" for ablation in ablations}
    pairs = {c: (name, policy) for c, name in names.items() if can_be_compared(results, name, policy)}
    return dict(zip(pairs, compare_pairs(results, list(pairs.values())), strict=True))


def _with_drop(cell: str, comparison: Comparison | None, level: str) -> str:
    """Add to a cell by how much the ablation changes the score."""
    if comparison is None:
        return cell
    for difference in comparison.levels:
        if difference.level == level:
            noise = " ≈" if difference.verdict == "noise" else ""
            text = f"{points(difference.difference, 0)} ({points_span(difference.interval, 0)}){noise}"
            return cell.replace("</td>", f'<small class="drop">{text}</small></td>')
    return cell


def _task_rows(results: Results, level: str, columns: list[tuple[str, str]]) -> str:
    return "".join(
        f'<tr><th scope="row">{prose(task)}<small>{prose(level)}</small></th>'
        + "".join(rate_cell(results.row(name, task, level, ablation)) for name, ablation in columns)
        + "</tr>"
        for task in results.tasks(level)
    )
