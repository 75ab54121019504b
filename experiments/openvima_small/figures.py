"""Figures about openvima-small; `publish.py` makes them from evaluations."""

from pathlib import Path
from typing import Any  # the type of matplotlib's axes is not public

from matplotlib import rc_context
from matplotlib.figure import Figure

from findings import LEVELS, POLICY, Findings
from openvima.evaluation.results import LevelMean
from openvima.report.published import leading_models

INK, FAINT, GRID, PAPER = "#1f2933", "#77818c", "#dfe3e9", "#ffffff"
OURS, PUBLISHED = "#0072b2", "#a9b2bc"
STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": FAINT,
    "axes.edgecolor": GRID,
    "axes.titlelocation": "left",
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.spines.left": False,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": FAINT,
    "ytick.color": INK,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
}
TITLES = {
    "L1": "L1 · new placements",
    "L2": "L2 · new combinations",
    "L3": "L3 · new objects",
    "L4": "L4 · new tasks",
}
_OWN = {
    "simulator": f"{POLICY}, original simulator",
    "default": POLICY,
    "previous": "previous weights",
}


def save_all(findings: Findings, folder: Path) -> dict[str, Path]:
    """Draw all figures with data.

    Returns:
        The files by name: levels, if there are scores.
    """
    if not findings.means():
        return {}
    file = folder / "openvima_small_levels.png"
    folder.mkdir(parents=True, exist_ok=True)
    with rc_context(STYLE):
        # without the matplotlib version, so that bytes depend on the picture only
        levels(findings).savefig(file, dpi=140, facecolor=PAPER, metadata={"Software": None})
    return {"levels": file}


def levels(findings: Findings) -> Figure:
    """A panel for each level: our means with their intervals, and the published ones."""
    models = sorted(leading_models(), key=lambda model: -model.levels["L1"])
    own = {what: means for name, what in _OWN.items() if (means := findings.means(name))}
    names = [*own, *(model.name for model in models)]
    figure = Figure(figsize=(11, 0.9 + 0.27 * len(names)), layout="constrained")
    for axes, level in zip(figure.subplots(1, len(LEVELS), sharey=True), LEVELS, strict=True):
        axes.set_title(TITLES[level])
        for place, means in enumerate(own.values()):
            if level in means:
                draw_bar(axes, place, means[level], OURS)
        for place, model in enumerate(models, len(own)):
            if level in model.levels:
                axes.barh(place, model.levels[level], color=PUBLISHED, height=0.66)
                draw_label(axes, model.levels[level], place, f"{model.levels[level]:.1f}")
        percent_axis(axes)
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.5, -0.6)
        axes.grid(visible=False, axis="y")
    for label in figure.axes[0].get_yticklabels()[: len(own)]:
        label.set(color=OURS, fontweight="bold")
    figure.supxlabel(
        "Success rate (%), mean over the tasks of the level. Blue: measured, with 95 % interval. "
        "Grey: published.",
        fontsize=8.5,
        color=FAINT,
        x=0.01,
        ha="left",
    )
    return figure


# Elements of the figures.


def draw_bar(axes: Any, place: float, mean: LevelMean, colour: str) -> None:
    """Draw a mean as a bar with its interval."""
    low, high = (100 * end for end in mean.interval)
    axes.barh(place, 100 * mean.mean, color=colour, height=0.66, linewidth=0)
    axes.plot([low, high], [place, place], color=INK, linewidth=1.3, solid_capstyle="butt")
    draw_label(axes, max(high, 100 * mean.mean), place, (f"{100 * mean.mean:.1f}", INK), bold=True)


def draw_label(axes: Any, x: float, y: float, text: str | tuple[str, str], *, bold: bool = False) -> None:
    """Write beside the end of a bar; a pair is text and colour."""
    words, colour = (text, FAINT) if isinstance(text, str) else text
    weight = "bold" if bold else "normal"
    axes.text(x + 2, y, words, va="center", fontsize=8, color=colour, fontweight=weight)


def percent_axis(axes: Any) -> None:
    """Scale from 0 to 100 %, with room for numbers beyond."""
    axes.set_xlim(0, 114)
    axes.set_xticks(range(0, 101, 25), [f"{tick} %" for tick in range(0, 101, 25)], fontsize=8)
