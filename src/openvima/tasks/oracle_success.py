"""Measured success of the oracle with this version of the tasks."""

import functools
import json
from collections.abc import Mapping
from importlib.resources import files

ORACLE_FILE = "oracle_success.json"


def oracle_record(task: str) -> Mapping[str, Mapping[str, int]]:
    """Return the number of evaluation episodes of a task that the oracle solved.

    Args:
        task: Name of the task.

    Returns:
        Level to {"episodes", "successes"}; empty for a task without a measurement. `benchmarks/oracle.py`
        writes the record.
    """
    return _records().get(task, {})


@functools.cache
def _records() -> dict[str, dict[str, dict[str, int]]]:
    return json.loads((files("openvima.tasks") / ORACLE_FILE).read_text(encoding="utf-8"))["tasks"]
