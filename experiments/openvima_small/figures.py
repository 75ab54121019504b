"""Figures about openvima-small; `publish.py` makes them from evaluations."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any  # the type of matplotlib's axes is not public

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from findings import DEMONSTRATIONS, LEVELS, POLICY, PUBLISHED_DEMONSTRATIONS, Findings, Training
from openvima.evaluation.results import LevelMean
from openvima.report.published import PublishedModel, leading_models, published_models

INK, FAINT, GRID, PAPER = "#1f2933", "#77818c", "#dfe3e9", "#ffffff"
OURS, VIMA, PUBLISHED = "#0072b2", "#d98200", "#a9b2bc"
STYLE: Any = {  # Any: the type of matplotlib's settings is not public either
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
SCALING_LEVELS = ("L1", "L3", "L4")


def save_all(findings: Findings, folder: Path) -> dict[str, Path]:
    """Draw all figures with data.

    Returns:
        The files by name: levels where there are scores, scaling and ablations where there are trainings.
    """
    with rc_context(STYLE):
        figures = {"levels": levels(findings)} if findings.means() else {}
        if findings.trainings:
            figures["scaling"] = scaling(findings)
        if findings.differences:
            figures["ablations"] = ablations(findings)
        folder.mkdir(parents=True, exist_ok=True)
        files = {name: folder / f"openvima_small_{name}.png" for name in figures}
        for name, figure in figures.items():
            # without the matplotlib version, so that bytes depend on the picture only
            figure.savefig(files[name], dpi=140, facecolor=PAPER, metadata={"Software": None})
    return files


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


def scaling(findings: Findings) -> Figure:
    """A panel for L1, L3 and L4: success against demonstrations, on a logarithmic axis."""
    figure = Figure(figsize=(11, 3.5), layout="constrained")
    panels = figure.subplots(1, len(SCALING_LEVELS), sharey=True)
    own = findings.means()
    for axes, level in zip(panels, SCALING_LEVELS, strict=True):
        axes.set_title(TITLES[level])
        draw_published(axes, level)
        draw_curve(axes, findings.curve(vima=True), level, VIMA, "VIMA architecture of similar size")
        draw_curve(axes, findings.curve(vima=False), level, OURS, "preset small")
        if level in own:
            draw_point(axes, DEMONSTRATIONS, own[level], OURS)
            axes.plot(
                [DEMONSTRATIONS],
                [100 * own[level].mean],
                "*",
                color=OURS,
                markersize=13,
                markeredgecolor=PAPER,
                label=POLICY,
                zorder=4,
            )
        axes.set_xscale("log")
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xticks([100, 1e3, 1e4, 1e5, 1e6], ["100", "1,000", "10,000", "100,000", "1 M"])
        axes.set_xlim(40, 1.4e6)
        axes.set_xlabel("demonstrations")
        axes.set_ylim(-2, 103)
        axes.set_yticks(range(0, 101, 25), [f"{tick} %" for tick in range(0, 101, 25)])
    handles, labels = panels[0].get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda k: "published" in labels[k])
    figure.legend(
        [handles[k] for k in order],
        [labels[k] for k in order],
        loc="outside lower center",
        ncols=3,
        frameon=False,
    )
    return figure


def ablations(findings: Findings) -> Figure:
    """Success of the baseline and its variants at each level, with paired differences."""
    assert findings.baseline  # there is none without differences
    shown = [findings.baseline, *findings.variants]
    names = list(findings.baseline.means())
    figure = Figure(figsize=(11, 0.9 + 0.36 * len(shown)), layout="constrained")
    for axes, level in zip(figure.subplots(1, len(names), sharey=True, squeeze=False)[0], names, strict=True):
        axes.set_title(TITLES.get(level, level))
        for place, training in enumerate(shown):
            mean = training.means().get(level)
            if mean is None:
                continue
            colour = VIMA if training.is_vima else OURS
            draw_bar(axes, place, mean, colour, faint=place > 0, label=False)
            draw_label(axes, 100 * mean.interval[1], place, difference_text(findings, training, level))
        percent_axis(axes, room=72)
        axes.set_yticks(range(len(shown)), [folded(training.what) for training in shown], fontsize=8.5)
        axes.set_ylim(len(shown) - 0.5, -0.6)
        axes.grid(visible=False, axis="y")
    full = findings.baseline
    figure.supxlabel(
        f"All with {full.demonstrations:,} demonstrations and {full.steps:,} steps. Lines: 95 % intervals. "
        "Numbers: difference to the first in points, on the same episodes; grey: not significant.",
        fontsize=8.5,
        color=FAINT,
        x=0.01,
        ha="left",
    )
    return figure


# Elements of the figures.


def draw_bar(
    axes: Any, place: float, mean: LevelMean, colour: str, *, faint: bool = False, label: bool = True
) -> None:
    """Draw a mean as a bar with its interval."""
    low, high = (100 * end for end in mean.interval)
    axes.barh(place, 100 * mean.mean, color=colour, height=0.66, alpha=0.55 if faint else 1.0, linewidth=0)
    axes.plot([low, high], [place, place], color=INK, linewidth=1.3, solid_capstyle="butt")
    if label:
        draw_label(axes, max(high, 100 * mean.mean), place, (f"{100 * mean.mean:.1f}", INK), bold=True)


def draw_label(axes: Any, x: float, y: float, text: str | tuple[str, str], *, bold: bool = False) -> None:
    """Write beside the end of a bar; a pair is text and colour."""
    words, colour = (text, FAINT) if isinstance(text, str) else text
    weight = "bold" if bold else "normal"
    axes.text(x + 2, y, words, va="center", fontsize=8, color=colour, fontweight=weight)


def draw_curve(axes: Any, trainings: Sequence[Training], level: str, colour: str, label: str) -> None:
    """Draw one architecture's success against demonstrations."""
    points = [(t.demonstrations, t.means()[level]) for t in trainings if level in t.means()]
    if not points:
        return
    counts, rates = [count for count, _ in points], [100 * mean.mean for _, mean in points]
    style = {"color": colour, "markersize": 5.5, "linewidth": 1.8, "zorder": 3}
    axes.plot(counts, rates, "-o", label=label, **style)
    for count, mean in points:
        draw_point(axes, count, mean, colour)


def draw_point(axes: Any, count: int, mean: LevelMean, colour: str) -> None:
    """Draw the interval of a point."""
    low, high = (100 * end for end in mean.interval)
    axes.plot([count, count], [low, high], color=colour, linewidth=2.4, alpha=0.45, solid_capstyle="round")


def draw_published(axes: Any, level: str) -> None:
    """Draw the published curves over fractions of the data, and VIMA-200M with all of it."""
    for model, mark in (("VIMA", "o"), ("MIDAS", "s")):
        fractions = sorted(_fractions(model, "92M"), key=lambda entry: entry.data_fraction)
        counts = [PUBLISHED_DEMONSTRATIONS * entry.data_fraction for entry in fractions]
        rates = [entry.levels[level] for entry in fractions]
        style = {"color": FAINT, "linewidth": 1.2, "markersize": 4, "markerfacecolor": PAPER}
        axes.plot(counts, rates, "--" + mark, label=f"{model} 92M, published", **style)
    for entry in _fractions("VIMA", "200M"):
        label = "VIMA 200M, published"
        axes.plot(
            [PUBLISHED_DEMONSTRATIONS], [entry.levels[level]], "D", color=INK, markersize=5, label=label
        )


def _fractions(model: str, size: str) -> list[PublishedModel]:
    return [entry for entry in published_models() if (entry.model, entry.size) == (model, size)]


def percent_axis(axes: Any, room: float = 14) -> None:
    """Scale from 0 to 100 %, with room for numbers beyond."""
    axes.set_xlim(0, 100 + room)
    axes.set_xticks(range(0, 101, 25), [f"{tick} %" for tick in range(0, 101, 25)], fontsize=8)


def difference_text(findings: Findings, training: Training, level: str) -> tuple[str, str]:
    """Label of a bar, and its colour."""
    if training is findings.baseline:
        return f"{100 * training.means()[level].mean:.1f}", INK
    found = {part.level: part for part in findings.differences[training.name].levels}.get(level)
    if found is None:
        return "", FAINT
    low, high = (f"{100 * end:+.1f}".replace("-", "−") for end in found.interval)
    text = f"{100 * found.difference:+.1f}".replace("-", "−")
    return f"{text}  ({low} to {high})", FAINT if found.verdict == "noise" else INK


def folded(text: str, width: int = 38) -> str:
    """Wrap a long label."""
    return "\n".join(textwrap.wrap(text, width))
