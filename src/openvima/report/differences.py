"""Section of the report on which policy is better, and whether that may be chance."""

from collections.abc import Sequence

from openvima.evaluation.comparison import Comparison, Difference
from openvima.html import breakable
from openvima.report.markup import folded, section
from openvima.report.text import counted, percent, points, points_span, probability, prose

_METHOD = (
    "Both policies played the same seeds, so each episode is compared with itself. Differences are in "
    "percentage points, with 95 % intervals (Tango’s for a task, its extension for means). p is that of the "
    "exact McNemar test; the mid-p is less cautious; adjusted, p makes up for the number of tasks, or of "
    "levels, compared on this page (Holm). A difference is inside the noise if its "
    "interval holds 0, and weak if it does not but the adjusted p is 0.05 or more."
)


def comparison_section(comparisons: Sequence[Comparison]) -> str:
    """Differences between pairs of policies; nothing where there are none."""
    if not comparisons:
        return ""
    return section(
        "comparison",
        "Comparison",
        "Differences between policies on the same episodes.",
        "".join(_comparison(comparison) for comparison in comparisons)
        + f'<p class="note">{prose(_METHOD)}</p>',
    )


def _comparison(comparison: Comparison) -> str:
    unpaired = (
        f'<p class="note">{prose(counted(comparison.unpaired, "episode"))} that only one of the two played '
        "are left out.</p>"
        if comparison.unpaired
        else ""
    )
    return (
        f'<div class="card compared"><h3>{prose(comparison.a)} against {prose(comparison.b)}</h3>'
        f"<p>{prose(finding(comparison))}</p>{unpaired}{_table(comparison, comparison.means)}</div>"
        + folded(f"{comparison.a} against {comparison.b}, task by task", _table(comparison, comparison.tasks))
    )


def finding(comparison: Comparison, difference: Difference | None = None) -> str:
    """One difference, by default the overall one, in a sentence."""
    difference = difference or comparison.overall
    where = difference.level or "all levels together"
    a, b, value, (low, high) = comparison.a, comparison.b, difference.difference, difference.interval
    if value < 0:  # a reader expects the better one first
        a, b, value, low, high = b, a, -value, -high, -low
    size = f"{points(value)} points ({points_span((low, high))})"
    if difference.verdict == "noise":
        return f"On {where}, {a} − {b} is {size}: inside the noise, it may well be chance."
    doubt = ", though the exact test leaves room for chance" if difference.verdict == "unsure" else ""
    return f"On {where}, {a} is better than {b}: {size}{doubt}."


def _table(comparison: Comparison, differences: Sequence[Difference]) -> str:
    rows = "".join(_row(comparison, difference) for difference in differences)
    return (
        '<div class="scroll"><table class="differences"><thead><tr><th scope="col">episodes of</th>'
        '<th scope="col" class="num">difference</th><th scope="col">from −100 to 100</th>'
        f'<th scope="col" class="num">{prose(comparison.a)}</th>'
        f'<th scope="col" class="num">{prose(comparison.b)}</th>'
        '<th scope="col" class="num">solved by one only</th><th scope="col" class="num">p (mid-p)</th>'
        f'<th scope="col" class="num">p adjusted</th></tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _row(comparison: Comparison, difference: Difference) -> str:
    return (
        f'<tr><th scope="row">{_name(difference)}</th>'
        f'<td class="num"><b>{points(difference.difference)}</b>'
        f"<small>{points_span(difference.interval)}</small></td>"
        f"<td>{interval_bar(difference)}{_mark(comparison, difference)}</td>"
        f'<td class="num">{percent(difference.rate_a, 1)}</td>'
        f'<td class="num">{percent(difference.rate_b, 1)}</td>'
        f'<td class="num">{difference.only_a} : {difference.only_b}</td>'
        f'<td class="num">{probability(difference.p_value)}'
        f"<small>({probability(difference.p_mid)})</small></td>"
        f'<td class="num">{probability(difference.p_holm)}</td></tr>'
    )


def interval_bar(difference: Difference) -> str:
    """The difference and its interval on a line from -100 to 100 points."""
    low, high = difference.interval
    left, right, middle = (50 + 50 * value for value in (low, high, difference.difference))
    return (
        f'<span class="span {difference.verdict}" aria-hidden="true">'
        f'<i style="left:{left:.1f}%;width:{right - left:.1f}%"></i><b style="left:{middle:.1f}%"></b></span>'
    )


def _name(difference: Difference) -> str:
    where = difference.level or "all levels"
    if difference.task:
        return f"{prose(breakable(difference.task))}<small>{prose(where)}</small>"
    return f"{prose(where)}<small>mean of {len(difference.pairs)}</small>"


def _mark(comparison: Comparison, difference: Difference) -> str:
    if difference.verdict == "noise":
        return '<span class="badge noise">≈ inside the noise</span>'
    if difference.verdict == "unsure":
        return '<span class="badge noise">? weak</span>'
    better = comparison.a if difference.verdict == "a" else comparison.b
    return f'<span class="badge good">✓ {prose(better)} is better</span>'
