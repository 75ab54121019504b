"""Training curves for the report, read from a run's `metrics.jsonl`."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from openvima.errors import DatasetError

Curve = Sequence[tuple[float, float]]

_KINDS = (("loss", False), ("accuracy", True))  # part of a metric's name, and whether it is a fraction
_HELD_OUT = "validation_"
_MOST_CURVES = 4  # more of them in one chart cannot be told apart


@dataclass(frozen=True, slots=True)
class Chart:
    """Curves that share one pair of axes.

    Args:
        title: What they show.
        curves: Name of each curve to its (step, value) points.
        percent: Whether values are fractions.
    """

    title: str
    curves: dict[str, Curve]
    percent: bool


def read_charts(metrics: Path) -> list[Chart]:
    """Read what the report shows of a training run: losses and accuracies over the steps of each stage.

    Args:
        metrics: A file with one JSON object a line: its "step", perhaps the "name" of its stage, and numbers.
            Those with "loss" or "accuracy" in their names are shown; "validation_" in front means held out.

    Returns:
        The charts; none where there is nothing to show.

    Raises:
        DatasetError: The file is not of that form.
    """
    stages: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for number, line in enumerate(metrics.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            record = json.loads(line)
            step, stage = float(record["step"]), str(record.get("name", "training"))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise DatasetError(f"{metrics}, line {number}, is no record with a step ({error!r}).") from error
        for name, value in record.items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                stages.setdefault(stage, {}).setdefault(name, []).append((step, float(value)))
    charts = []
    for stage, values in stages.items():
        for kind, percent in _KINDS:
            chosen = _chosen(sorted(name for name in values if kind in name))
            if chosen:
                curves: dict[str, Curve] = {_label(name, kind): values[name] for name in chosen}
                charts.append(Chart(f"{_stage_title(stage)}: {kind}", curves, percent))
    return charts


def _chosen(names: list[str]) -> list[str]:
    """All metrics of a kind, or the held-out ones alone where all would be too many."""
    held_out = [name for name in names if name.startswith(_HELD_OUT)]
    return held_out[:_MOST_CURVES] if held_out and len(names) > _MOST_CURVES else names[:_MOST_CURVES]


def _stage_title(name: str) -> str:
    """Name of a stage without its number, such as "Cloning" for "2-cloning"."""
    return name.lstrip("0123456789-").capitalize() or name


def _label(name: str, kind: str) -> str:
    """Name of a curve, such as "pick, held out" for "validation_pick_accuracy"."""
    what = name.removeprefix(_HELD_OUT).replace(kind, "").strip("_").replace("_", " ")
    seen = "held out" if name.startswith(_HELD_OUT) else "training data"
    return f"{what}, {seen}" if what else seen
