"""What each seed means is recorded: a digest of the first episodes of every task and level.

A change here changes every published number. If it is meant, run this file as a script to write the digests
anew, raise `ENVIRONMENT_VERSION` once there has been a release, and note it in CHANGELOG.md.
"""

import hashlib
import json
import re
from pathlib import Path

import pytest

from openvima.catalog.partitions import PUBLISHED_TASKS
from openvima.tasks import list_tasks, sample_episode, task_spec
from task_cases import full_repr

RECORD = Path(__file__).parents[1] / "golden" / "episode_digests.json"
NUM_SEEDS = 20
_FLOAT = re.compile(r"-?\d+\.\d+(?:e[+-]?\d+)?")


def digest(task: str, level: str, *, compat: bool = False) -> str:
    """Digest of the first problems, numbers rounded to a micrometre so that it holds on every machine."""
    total = hashlib.sha256()
    for seed in range(NUM_SEEDS):
        text = full_repr(sample_episode(task, level=level, seed=seed, domain="eval", compat=compat).problem)
        text = text.replace("prerequisites=", "oracle_first=")  # the field's name in the recorded digests
        total.update(_FLOAT.sub(lambda match: f"{float(match[0]) + 0.0:.6f}", text).encode())
    return total.hexdigest()[:16]


def digests(task: str) -> dict[str, str]:
    """Level to digest; for published tasks also that of the starts with `compat`."""
    levels = task_spec(task).levels
    compat = {"compat": digest(task, levels[0], compat=True)} if task in PUBLISHED_TASKS else {}
    return {level: digest(task, level) for level in levels} | compat


@pytest.mark.parametrize("task", list_tasks())
def test_seeds_mean_what_they_meant(task: str) -> None:
    recorded = json.loads(RECORD.read_text(encoding="utf-8"))
    assert recorded[task] == digests(task)


if __name__ == "__main__":
    recorded = {task: digests(task) for task in list_tasks()}
    RECORD.write_text(json.dumps(recorded, indent=1) + "\n", encoding="utf-8")
