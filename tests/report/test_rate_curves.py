"""Success rates over a quantity: charts and tables, with published ones beside."""

import re

from openvima.report.figures import (
    RateCurve,
    RateFigure,
    RatePanel,
    RatePoint,
    rate_figure_html,
    rate_table,
)
from openvima.report.published import data_fraction_curves, model_size_curves, size_ticks
from openvima.report.table import markdown


def figure() -> RateFigure:
    own = RateCurve("mi<ne", (RatePoint(0.01, 0.2, (0.1, 0.3)), RatePoint(1, 0.5, (0.4, 0.6))))
    panels = tuple(RatePanel(level, (own, *data_fraction_curves(level))) for level in ("L1", "L4"))
    return RateFigure("data", "Success.", "fraction", panels, {0.01: "1 %", 1: "100 %"}, logarithmic=True)


def test_published_curves_hold_every_size_and_fraction():
    sizes = {curve.name: [point.x for point in curve.points] for curve in model_size_curves("L1")}
    assert sizes["VIMA"] == [2e6, 4e6, 9e6, 20e6, 43e6, 92e6, 200e6]
    assert set(sizes) == {
        *(f"VIMA{name}" for name in ("", "-Gato", "-Flamingo", "-GPT")),
        "MIDAS",
        "MIDAS without pretraining",
    }
    fractions = {c.name: [(p.x, round(p.rate, 3)) for p in c.points] for c in data_fraction_curves("L3")}
    assert fractions["VIMA 92M"] == [(0.001, 0), (0.01, 0.154), (0.1, 0.732), (1, 0.819)]
    assert [x for x, _ in fractions["MIDAS 92M"]] == [0.1, 0.5, 1]
    assert size_ticks(model_size_curves("L1"))[92e6] == "92M"


def test_the_table_has_a_row_for_each_curve_of_each_panel():
    text = markdown([rate_table(figure())])
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    assert rows[0] == ["policy", "level", "0.001", "1 %", "0.1", "0.5", "100 %"]
    assert rows[2] == ["mi\\<ne", "L1", "–", "20.0 (10.0 to 30.0)", "–", "–", "50.0 (40.0 to 60.0)"]
    assert rows[3] == ["VIMA 92M (published)", "L1", "0.0", "36.3", "76.2", "–", "79.3"]
    assert rows[-1][0] == "MIDAS 92M (published)" and rows[-1][-1] == "59.1\\*"


def test_charts_tell_measured_from_published_curves_and_share_colours():
    text = rate_figure_html(figure(), {"mi<ne": "--series-3"})
    charts = re.findall(r"<svg.*?</svg>", text, flags=re.DOTALL)
    assert len(charts) == 2 and "mi&lt;ne" in text and "mi<ne" not in text
    assert all("var(--series-3)" in chart for chart in charts)
    assert text.count('class="dot hollow"') == 2 and "VIMA 92M (published)" in text
    assert all(chart.count("stroke-dasharray") >= 2 for chart in charts)
    names = re.findall(r'\bid="([^"]*)"', text)
    assert len(names) == len(set(names))
