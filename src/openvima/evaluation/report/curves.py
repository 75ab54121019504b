"""Training curves for the report, read from a run's `metrics.jsonl`."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from openvima.errors import DatasetError

Curve = Sequence[tuple[float, float]]
Chart = tuple[str, str, bool, Mapping[str, Curve]]  # title, label of the values, are they fractions, curves


def read_charts(metrics: Path) -> list[Chart]:
    """Read what the report shows of a training run: losses and accuracies over steps.

    Every number with "loss" or "accuracy" in its name becomes a curve; those of one kind share a chart.

    Args:
        metrics: A file with one JSON object a line, each with a "step".

    Returns:
        The charts; none where there is nothing to show.

    Raises:
        DatasetError: The file is not of that form.
    """
    curves: dict[str, list[tuple[float, float]]] = {}
    for number, line in enumerate(metrics.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            record = json.loads(line)
            step = float(record["step"])
        except (ValueError, KeyError, TypeError) as error:
            raise DatasetError(f"{metrics}, line {number}, is no record with a step ({error!r}).") from error
        for name, value in record.items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                curves.setdefault(name, []).append((step, float(value)))
    charts: list[Chart] = []
    for kind, label, percent in (("loss", "Loss", False), ("accuracy", "Accuracy of the actions", True)):
        chosen = {_readable(name): points for name, points in curves.items() if kind in name}
        if chosen:
            charts.append((f"Training {kind}", label, percent, chosen))
    return charts


def _readable(name: str) -> str:
    return name.replace("_", " ").replace("/", " ")
