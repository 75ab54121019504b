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


def digest(task: str) -> str:
    """Digest over everything that the oracle's run at the hardest level shows and does."""
    try:
        return rollout_oracle(TabletopEnv(task, level=task_spec(task).levels[-1]), 0).content_hash()
    except OracleError as error:
        return str(error)


@pytest.mark.slow
def test_what_was_played_before_leaves_no_trace() -> None:
    """Caches of models, shapes and images are warm the second time, in another order."""
    envs = {task: TabletopEnv(task) for task in list_tasks()}
    order = [(task, 0) for task in envs]
    first = {key: rollout_oracle(envs[key[0]], key[1]).content_hash() for key in order}
    fresh = {key: rollout_oracle(TabletopEnv(key[0]), key[1]).content_hash() for key in reversed(order)}
    assert first == fresh


FAST_TIER = ("rotate", "sweep_without_exceeding")  # one task for each end effector


@pytest.mark.parametrize(
    "tasks", [FAST_TIER, pytest.param(tuple(list_tasks()), marks=pytest.mark.slow)], ids=["two", "all"]
)
def test_two_processes_give_the_same_bytes(tasks: tuple[str, ...]) -> None:
    code = (
        "import importlib.util, json; "
        f"spec = importlib.util.spec_from_file_location('test', {__file__!r}); "
        "module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module); "
        f"print(json.dumps({{task: module.digest(task) for task in {tasks!r}}}))"
    )
    settings = {"OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "2", "OPENBLAS_CORETYPE": "Prescott"}
    command, environment = [sys.executable, "-c", code], {**os.environ, **settings}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    expected = {task: digest(task) for task in tasks}
    assert len(set(expected.values())) == len(tasks)
    assert json.loads(run.stdout) == expected
