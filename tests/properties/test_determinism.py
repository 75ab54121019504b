"""The same seed gives the same bytes in every process."""

import json
import os
import subprocess
import sys

import pytest

from openvima.data import rollout_oracle
from openvima.env import TabletopEnv
from openvima.errors import OracleError
from openvima.tasks import list_tasks, task_spec

SEEDS = range(3)


def digests(task: str) -> list[str]:
    """One digest for each level and seed, over everything that the oracle's run shows and does."""
    found = []
    for level in task_spec(task).levels:
        env = TabletopEnv(task, level=level, domain="eval")
        for seed in SEEDS:
            try:
                found.append(rollout_oracle(env, seed).content_hash())
            except OracleError as error:
                found.append(str(error))
    return found


@pytest.mark.slow
def test_what_was_played_before_leaves_no_trace() -> None:
    """Caches of models, shapes and images are warm the second time, and in another order."""
    envs = {task: TabletopEnv(task) for task in list_tasks()}
    order = [(task, seed) for task in envs for seed in SEEDS]
    first = {key: rollout_oracle(envs[key[0]], key[1]).content_hash() for key in order}
    again = {key: rollout_oracle(envs[key[0]], key[1]).content_hash() for key in reversed(order)}
    fresh = {key: rollout_oracle(TabletopEnv(key[0]), key[1]).content_hash() for key in order}
    assert first == again == fresh


FAST_TIER = ("rotate", "sweep_without_exceeding")  # one task for each end effector


@pytest.mark.parametrize(
    "tasks", [FAST_TIER, pytest.param(tuple(list_tasks()), marks=pytest.mark.slow)], ids=["two", "all"]
)
def test_two_processes_give_the_same_bytes(tasks: tuple[str, ...]) -> None:
    code = (
        "import importlib.util, json; "
        f"spec = importlib.util.spec_from_file_location('test', {__file__!r}); "
        "module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module); "
        f"print(json.dumps({{task: module.digests(task) for task in {tasks!r}}}))"
    )
    runs = [
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "OMP_NUM_THREADS": "1", **settings},
            capture_output=True,
            text=True,
            check=True,
        )
        for settings in ({"PYTHONHASHSEED": "1"}, {"PYTHONHASHSEED": "2", "OPENBLAS_CORETYPE": "Prescott"})
    ]
    expected = {task: digests(task) for task in tasks}
    assert all(len(set(found)) == len(found) for found in expected.values())
    assert [json.loads(run.stdout) for run in runs] == [expected, expected]
