"""Training curves for the report, read from the `metrics.jsonl` of training runs."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from openvima.errors import DatasetError
from openvima.input_files import MALFORMED
from openvima.policies.naming import METRICS_FILE

Curve = Sequence[tuple[float, float]]

_KINDS = (  # part of a metric's name, and whether it is a fraction
    ("loss", False),
    ("accuracy", True),
    ("success", True),
)
_HELD_OUT = "validation_"
_MOST_CURVES = 4  # in one chart


@dataclass(frozen=True, slots=True)
class Chart:
    """Curves that share one pair of axes.

    Args:
        title: Title of the chart.
        curves: Name of each curve to its (step, value) points.
        percent: Whether values are fractions.
    """

    title: str
    curves: dict[str, Curve]
    percent: bool


def read_run_charts(runs: Sequence[Path]) -> list[Chart]:
    """Read the charts of training runs; those of several say in their titles whose they are.

    Args:
        runs: Run folders or their `metrics.jsonl`.

    Raises:
        DatasetError: A run has no record, or a damaged one.
    """
    labels = [f"{label} · " for label in run_labels(runs)] if len(runs) > 1 else [""] * len(runs)
    return [chart for label, run in zip(labels, runs, strict=True) for chart in read_charts(run, label)]


def run_labels(folders: Sequence[Path]) -> list[str]:
    """Short distinct names for folders: the last part of the path, or as much of it as tells them apart."""
    parts = [folder.resolve().parts for folder in folders]
    for length in range(1, max(map(len, parts), default=1) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{part[-1]} {number}" for number, part in enumerate(parts, start=1)]


def read_charts(run: Path, label: str = "") -> list[Chart]:
    """Read the charts of a training run: losses and accuracies over the steps of each stage.

    Args:
        run: A run folder or its training record: a file with one JSON object a line, its "step", perhaps the
            "name" of its stage, and numbers. Those with "loss" or "accuracy" in their names are charted;
            "validation_" means held out.
        label: Begins the titles.

    Returns:
        The charts.

    Raises:
        DatasetError: There is no file, or it is not of that form.
    """
    metrics = run / METRICS_FILE if run.is_dir() else run
    if not metrics.is_file():
        raise DatasetError(f"there is no {metrics}; give the folder of a training run or its {METRICS_FILE}.")
    stages: dict[str, dict[str, list[tuple[float, float]]]] = {}
    try:
        lines = metrics.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise DatasetError(f"{metrics} is no text with a record a line ({error}).") from error
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            step, stage = float(record["step"]), str(record.get("name", "training"))
            for name, value in record.items():
                if isinstance(value, int | float) and not isinstance(value, bool):
                    stages.setdefault(stage, {}).setdefault(name, []).append((step, float(value)))
        except MALFORMED as error:
            raise DatasetError(f"{metrics}, line {number}, is no record with a step ({error!r}).") from error
    charts = []
    for stage, values in stages.items():
        for kind, percent in _KINDS:
            chosen = _chosen(sorted(name for name in values if kind in name))
            if chosen:
                curves: dict[str, Curve] = {_label(name, kind): values[name] for name in chosen}
                # "Cloning" for "2-cloning"
                title = stage.lstrip("0123456789-").capitalize() or stage
                charts.append(Chart(f"{label}{title}: {kind}", curves, percent))
    return charts


def _chosen(names: list[str]) -> list[str]:
    """All metrics of a kind, or the held-out ones alone where all would be too many."""
    held_out = [name for name in names if name.startswith(_HELD_OUT)]
    return held_out[:_MOST_CURVES] if held_out and len(names) > _MOST_CURVES else names[:_MOST_CURVES]


def _label(name: str, kind: str) -> str:
    """Name of a curve, such as "pick, held out" for "validation_pick_accuracy"."""
    what = name.removeprefix(_HELD_OUT).replace(kind, "").strip("_/").replace("_", " ")
    seen = "held out" if name.startswith(_HELD_OUT) else "training data"
    return f"{what}, {seen}" if what else seen
