"""Success rates over a quantity, such as model size or a corruption rate: records and table."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from openvima.evaluation.statistics import Interval
from openvima.report.typesetting import Estimate, Line, Table


@dataclass(frozen=True, slots=True)
class RatePoint:
    """A success rate at one value of the quantity.

    Args:
        x: Value of the quantity.
        rate: Success rate, as a fraction.
        interval: Its 95 % interval; None where it is not known.
        mark: Put behind the number in tables.
        seeds: Rates of single training seeds, drawn as dashes.
    """

    x: float
    rate: float
    interval: Interval | None = None
    mark: str = ""
    seeds: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class RateCurve:
    """Success rates of one policy or model.

    Args:
        name: Its name; equal names share a colour.
        points: In ascending order of the quantity.
        published: Whether the numbers are from a paper, not measured here.
    """

    name: str
    points: tuple[RatePoint, ...]
    published: bool = False


@dataclass(frozen=True, slots=True)
class RatePanel:
    """Curves that share one pair of axes, such as those of a level.

    Args:
        title: Its title.
        curves: Those of one name have one colour, and one row in the table.
    """

    title: str
    curves: tuple[RateCurve, ...]


@dataclass(frozen=True, slots=True)
class RateFigure:
    """Panels over the same quantity.

    Args:
        label: Short name of letters, digits and hyphens, unique in a page.
        caption: What is shown.
        quantity: The quantity with its unit: label of the horizontal axis.
        panels: One chart each.
        ticks: Names of values of the quantity, where they are not plain numbers.
        logarithmic: Whether the horizontal axis is.
        named: Whether values are 0, 1, 2, … for the names in `ticks`, in any order: curves are not joined.
    """

    label: str
    caption: str
    quantity: str
    panels: tuple[RatePanel, ...]
    ticks: Mapping[float, str] = field(default_factory=dict)
    logarithmic: bool = False
    named: bool = False

    @property
    def curves(self) -> dict[str, RateCurve]:
        """One curve of each name, measured ones first."""
        all_curves = [curve for panel in self.panels for curve in panel.curves]
        return {curve.name: curve for curve in sorted(all_curves, key=lambda curve: curve.published)}

    def tick(self, x: float) -> str:
        """Name of a value of the quantity."""
        return self.ticks.get(x, f"{x:g}")


def rate_table(figure: RateFigure) -> Table:
    """Write the numbers of a figure as a table: a row for each curve of each panel."""
    values = sorted({p.x for panel in figure.panels for curve in panel.curves for p in curve.points})
    lines = []
    for panel in figure.panels:
        for index, (name, published) in enumerate(
            {curve.name: curve.published for curve in panel.curves}.items()
        ):
            points = {
                point.x: point for curve in panel.curves if curve.name == name for point in curve.points
            }
            cells = [_cell(points[x]) if x in points else "–" for x in values]
            shown = f"{name} (published)" if published else name
            lines.append(Line(shown, (panel.title, *cells), starts_group=index == 0 and bool(lines)))
    columns = ("policy", "level", *map(figure.tick, values))
    caption = f"{figure.caption} Columns: {figure.quantity}. Rates in %, with 95 % intervals."
    return Table(figure.label, caption, columns, tuple(lines))


def _cell(point: RatePoint) -> Estimate | str:
    if point.interval is None:
        return f"{100 * point.rate:.1f}{point.mark}"
    return Estimate(point.rate, point.interval, mark=point.mark)
