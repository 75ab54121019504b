"""Costs of a finished or interrupted training, from the logs of its folder."""

from pathlib import Path
from typing import Any

from openvima.training.run_folder import METRICS_FILE, TIMINGS_FILE, whole_lines

_TIMES = ("seconds_since_start", "cpu_seconds_since_start")


def logged_costs(run: Path) -> dict[str, Any]:  # Any: JSON
    """Return steps, time and CPU time of a run.

    Work that was repeated after an interruption counts twice; what was lost after the last line of the log
    does not count.

    Args:
        run: The run folder.

    Returns:
        "steps" of each stage by name, "seconds" and "cpu_seconds" of all sessions together.
    """
    steps: dict[str, int] = {}
    for record in _records(run / METRICS_FILE):
        steps[record["name"]] = max(record["step"], steps.get(record["name"], 0))
    totals, last = dict.fromkeys(_TIMES, 0.0), dict.fromkeys(_TIMES, 0.0)
    for record in _records(run / TIMINGS_FILE):
        is_new = record[_TIMES[0]] < last[_TIMES[0]]  # a session begins at 0
        for name in _TIMES:
            totals[name] += record[name] - (0.0 if is_new else last[name])
            last[name] = record[name]
    return {
        "steps": steps,
        "seconds": round(totals[_TIMES[0]], 1),
        "cpu_seconds": round(totals[_TIMES[1]], 1),
    }


def _records(file: Path) -> list[dict[str, Any]]:  # Any: JSON
    """Read a log; empty without one."""
    return [values for _, values in whole_lines(file)] if file.is_file() else []
