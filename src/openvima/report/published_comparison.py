"""Section of the report with published results."""

from collections.abc import Sequence

from openvima.evaluation.results import Results
from openvima.report.markup import DOT, folded, section
from openvima.report.published import (
    RELIABILITY,
    PublishedModel,
    leading_models,
    published_models,
    published_tasks,
)
from openvima.report.tables import mean_cell
from openvima.report.text import prose, series_colours


def published_section(results: Results) -> str:
    """Level means beside those of the papers; empty if no published level was evaluated."""
    levels = [level for level in results.levels() if published_tasks(level)]
    if not levels:
        return ""
    leading = leading_models()
    others = [model for model in published_models() if model not in leading]
    return section(
        "published",
        "Published results",
        "Means over the tasks of each level (%). " + _coverage(results, levels),
        f'<div class="card scroll"><table class="rates">{_head(levels)}<tbody>{_own_rows(results, levels)}'
        f'</tbody><tbody class="elsewhere">{_rows(leading, levels)}</tbody></table></div>'
        f'<p class="note">{prose(RELIABILITY)}</p>'
        + folded(
            "All sizes, and smaller shares of the data",
            f'<div class="scroll"><table class="rates">{_head(levels)}<tbody class="elsewhere">'
            f"{_rows(others, levels)}</tbody></table></div>",
        ),
    )


def _coverage(results: Results, levels: Sequence[str]) -> str:
    """Say on how many of a level's tasks our means rest, where it is not all."""
    partial = [
        f"{len(set(results.tasks(level)) & published_tasks(level).keys())} of {len(published_tasks(level))} "
        f"tasks at {level}"
        for level in levels
        if published_tasks(level).keys() - set(results.tasks(level))
    ]
    if not partial:
        return "Published means rest on the same tasks."
    return f"Published means rest on all tasks, those of this evaluation on {', '.join(partial)}."


def _head(levels: Sequence[str]) -> str:
    return (
        '<thead><tr><th scope="col">policy</th>'
        + "".join(f'<th scope="col">{prose(level)}</th>' for level in levels)
        + "</tr></thead>"
    )


def _own_rows(results: Results, levels: Sequence[str]) -> str:
    colours = series_colours(results)
    means = {(mean.policy, mean.level): mean for mean in results.level_means() if not mean.ablation}
    return "".join(
        f'<tr><th scope="row" style="--series:var({colours[policy]})">{DOT}{prose(policy)}'
        "<small>this evaluation</small></th>"
        + "".join(mean_cell(means.get((policy, level)), len(published_tasks(level))) for level in levels)
        + "</tr>"
        for policy in results.policy_names()
    )


def _rows(models: Sequence[PublishedModel], levels: Sequence[str]) -> str:
    return "".join(
        f'<tr><th scope="row">{prose(model.name)}</th>'
        + "".join(f"<td>{prose(model.written(level))}</td>" for level in levels)
        + "</tr>"
        for model in models
    )
