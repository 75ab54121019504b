"""Charts of the report: plain SVG that takes its colours from the page, so that it suits light and dark.

A `RateFigure` holds success rates over a quantity, such as model size or a corruption rate.
"""

import html
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from typing import Any

from openvima.evaluation.statistics import Interval
from openvima.html import render_page
from openvima.report.curves import Chart


@dataclass(frozen=True, slots=True)
class RatePoint:
    """A success rate at one value of the quantity.

    Args:
        x: Value of the quantity.
        rate: Success rate, as a fraction.
        interval: Its 95 % interval; None where it is not known.
        seeds: Rates of single training seeds, drawn as dashes.
    """

    x: float
    rate: float
    interval: Interval | None = None
    seeds: tuple[float, ...] = ()


Curves = Mapping[tuple[str, bool], Sequence[RatePoint]]
"""By name, and whether the numbers are from a paper, not measured here."""


@dataclass(frozen=True, slots=True)
class RateFigure:
    """Panels over the same quantity, such as one of each level.

    Args:
        caption: What is shown.
        quantity: The quantity with its unit: label of the horizontal axis.
        panels: Curves by the title of their chart; those of one name have one colour.
        ticks: Names of values of the quantity, where they are not plain numbers.
        logarithmic: Whether the horizontal axis is.
        named: Whether values are 0, 1, 2, … for the names in `ticks`, in any order: curves are not joined.
    """

    caption: str
    quantity: str
    panels: Mapping[str, Curves]
    ticks: Mapping[float, str] = field(default_factory=dict)
    logarithmic: bool = False
    named: bool = False

    def tick(self, x: float) -> str:
        """Name of a value of the quantity."""
        return self.ticks.get(x, f"{x:g}")


# Stand-ins that matplotlib draws with; the page's colours replace them, see `_themed`.
_INK, _MUTED, _GRID = "#010101", "#020202", "#030303"
_PANEL_WIDTH_IN = 3.9
_DODGE = 0.16  # between the curves of named values, which are 1 apart
_PERCENT_TICKS = range(0, 101, 25), [f"{tick} %" for tick in range(0, 101, 25)]
_STYLE: Any = {
    "svg.hashsalt": "openvima",  # element names in the file are the same in every run
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9.5,
    "text.color": _INK,
    "axes.labelcolor": _MUTED,
    "axes.edgecolor": _GRID,
    "xtick.color": _MUTED,
    "ytick.color": _MUTED,
    "grid.color": _GRID,
    "grid.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.spines.left": False,
}


def rate_chart(rates: RateFigure, title: str, name: str, colours: Mapping[str, str]) -> str:
    """Draw one panel of success rates over a quantity; published ones are dashed, with hollow dots.

    Args:
        rates: The figure.
        title: That of one of its panels.
        name: Put before the names of its elements; no other chart of the page may have it.
        colours: Name of each curve to the CSS variable of its colour.

    Returns:
        An `<svg>` element.
    """
    curves = rates.panels[title]
    figure, axes = _panel(3.6 if rates.named else 2.6)
    for number, ((policy, is_published), points) in enumerate(curves.items()):
        colour = _series(colours[policy])
        shift = _DODGE * (number - (len(curves) - 1) / 2) if rates.named else 0.0
        style: dict[str, Any] = {"linewidth": 1.8, "markersize": 4.5}
        if is_published:
            style = {"linestyle": (0, (3, 2)), "linewidth": 1.2, "markerfacecolor": "none", "markersize": 4}
        if rates.named:
            style["linestyle"] = "none"
        at = [point.x + shift for point in points]
        axes.plot(at, _percent(point.rate for point in points), marker="o", color=colour, **style)
        for x, point in zip(at, points, strict=True):
            seeds = _percent(point.seeds)
            axes.plot([x] * len(seeds), seeds, "_", color=colour, markersize=8, markeredgewidth=1.2)
            axes.vlines(x, *_percent(point.interval or (0, 0)), color=colour, linewidth=2.4, alpha=0.4)
    if rates.logarithmic:
        axes.set_xscale("log")
    tilt: Any = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"} if rates.named else {}
    panels = (points for panel in rates.panels.values() for points in panel.values())
    values = sorted({point.x for points in panels for point in points})
    axes.set_xticks(values, list(map(rates.tick, values)), **tilt)
    axes.set_xticks([], minor=True)
    axes.set_ylim(-3, 103)
    axes.set_yticks(*_PERCENT_TICKS)
    axes.set_xlabel(rates.quantity)
    return _themed(figure, name, f"{rates.caption} {title}", [colours[policy] for policy, _ in curves])


def curve_chart(chart: Chart, name: str) -> str:
    """Draw curves over training steps; fractions on an axis from 0 to 100 %.

    Args:
        chart: The curves.
        name: Put before the names of its elements; no other chart of the page may have it.

    Returns:
        An `<svg>` element.
    """
    variables = [f"--series-{index + 1}" for index in range(len(chart.curves))]
    figure, axes = _panel(2.5)
    for (label, points), variable in zip(chart.curves.items(), variables, strict=True):
        steps, values = zip(*points, strict=True)
        marker = "o" if len(points) < 30 else ""
        style: Any = {"marker": marker, "markersize": 3.5, "color": _series(variable), "linewidth": 1.8}
        axes.plot(steps, _percent(values) if chart.percent else values, label=label, **style)
    if chart.percent:
        axes.set_ylim(-2, 102)
        axes.set_yticks(*_PERCENT_TICKS)
    axes.set_title(chart.title, loc="left", fontsize=10, color=_INK)
    axes.set_xlabel("step")
    if len(variables) > 1:
        axes.legend(frameon=False, fontsize=9, labelcolor=_INK)
    return _themed(figure, name, chart.title, variables)


def _percent(fractions: Iterable[float]) -> list[float]:
    return [100 * fraction for fraction in fractions]


def _panel(height_in: float) -> tuple[Any, Any]:
    """Make a figure with one pair of axes."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        figure = Figure(figsize=(_PANEL_WIDTH_IN, height_in), layout="constrained")
        axes = figure.subplots()
    axes.tick_params(length=0)
    return figure, axes


def _series(variable: str) -> str:
    """Stand-in colour for a CSS variable: distinct for the names in use, never one of the fixed ones."""
    return "#04" + f"{sum(ord(c) * 31**i for i, c in enumerate(variable)) % 0xFFFF:04x}"


def _themed(figure: Any, name: str, title: str, variables: Iterable[str]) -> str:
    """Turn a figure into an `<svg>` element for the page.

    Args:
        figure: The matplotlib figure.
        name: Put before every element's name, which must be unique in the page.
        title: What screen readers say.
        variables: CSS variables of the series' colours.
    """
    from matplotlib import rc_context
    from matplotlib.text import Text

    for words in figure.findobj(Text):
        words.set_parse_math(False)  # a $ in a name is no formula
    text = io.StringIO()
    with rc_context(_STYLE):
        metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(text, format="svg", metadata=metadata, transparent=True)
    svg = text.getvalue()
    colours = {_series(variable): variable for variable in variables}
    for stand_in, variable in (colours | {_INK: "--ink", _MUTED: "--muted", _GRID: "--line"}).items():
        svg = svg.replace(stand_in, f"var({variable})")
    width, height = 72 * figure.get_size_inches()
    body = svg[svg.index("<defs>") :]
    for pattern, replacement in (
        (r"<style.*?</style>", ""),  # would apply to the whole page
        (r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px"),  # letters are those of the page
        (r"font-family: [^;\"]*;?", ""),
        ("xlink:href", "href"),
        (r'\bid="', f'id="{name}-'),
        (r'(url\(|href=")#', rf"\1#{name}-"),
    ):
        body = re.sub(pattern, replacement, body, flags=re.DOTALL)
    head = f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{html.escape(title)}">'
    return head + body.rstrip()


# CSS variables of the style sheet.
_COLOURS = tuple(f"--series-{name}" for name in (1, 2, 3, 4, 5, 6, "untrained", "random", "oracle"))


def rate_figure_html(figure: RateFigure) -> str:
    """Draw a figure: legend, and one chart a panel.

    Args:
        figure: The figure.

    Returns:
        An HTML fragment for a page with the package's style sheet.

    Raises:
        MissingExtraError: matplotlib or Jinja is not installed.
    """
    curves = sorted((curve for panel in figure.panels.values() for curve in panel), key=lambda c: c[1])
    legend = dict(reversed(curves))  # a name is published if all its curves are
    colours = dict(zip(dict(curves), cycle(_COLOURS), strict=False))
    return render_page(
        "report/rate_figure",
        figure=figure,
        legend=legend,
        colours=colours,
        charts=[
            rate_chart(figure, title, f"rates-{number}", colours)
            for number, title in enumerate(figure.panels)
        ],
    )
