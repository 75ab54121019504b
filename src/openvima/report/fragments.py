"""Parts that several pages share, as HTML fragments: figures of success rates, tables."""

from collections.abc import Mapping
from itertools import cycle

from openvima.html import render_page
from openvima.report.figures import rate_chart
from openvima.report.rate_curves import RateFigure, rate_table
from openvima.report.typesetting import Table

# CSS variables of the style sheet.
_COLOURS = tuple(f"--series-{name}" for name in (1, 2, 3, 4, 5, 6, "untrained", "random", "oracle"))


def rate_figure_html(figure: RateFigure, colours: Mapping[str, str] | None = None) -> str:
    """Draw a figure: legend, one chart a panel, and its numbers in a table to unfold.

    Args:
        figure: The figure.
        colours: CSS variables of curves that have a colour already, such as "--series-1".

    Returns:
        An HTML fragment for a page with the package's style sheet.

    Raises:
        MissingExtraError: matplotlib or Jinja is not installed.
    """
    known = {name: colour for name, colour in (colours or {}).items() if name in figure.curves}
    free = cycle([colour for colour in _COLOURS if colour not in known.values()] or _COLOURS)
    known |= {name: next(free) for name in figure.curves if name not in known}
    return render_page(
        "report/rate_figure",
        figure=figure,
        colours=known,
        charts=[rate_chart(figure, index, known) for index in range(len(figure.panels))],
        table=rate_table(figure),
    )


def table_html(table: Table) -> str:
    """Write a table as HTML, for a page with the package's style sheet."""
    return render_page("report/table", table=table)
