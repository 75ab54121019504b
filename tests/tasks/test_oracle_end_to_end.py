"""The oracle solves every task at every level in the real environment.

Run as a script for as many seeds as wanted: `python tests/tasks/test_oracle_end_to_end.py 300`.
"""

import collections
import sys
from collections.abc import Iterator

import pytest

from openvima.catalog.partitions import PUBLISHED_LEVELS
from openvima.env import TabletopEnv
from openvima.errors import OracleError
from openvima.tasks import list_tasks, task_spec

EVERYWHERE = [(task, level) for task in list_tasks() for level in task_spec(task).levels]


def play(env: TabletopEnv, seed: int) -> str:
    """Let the oracle play one episode: "success", or why it is none."""
    env.reset(seed=seed)
    for _ in range(env.episode.oracle_max_steps):
        try:
            decision = env.oracle_decision()
        except OracleError as error:
            return str(error)
        observation, reward, terminated, truncated, info = env.step(decision.action)
        assert observation in env.observation_space
        assert info["success"] == (reward == 1) and not truncated
        if env.scene.end_effector == "suction" and info["grasped"] != decision.pick_id:
            return f"grasped {info['grasped']} instead of {decision.pick_id}"
        if terminated:
            return "success" if info["success"] else info["reason"]
    return f"not done after {env.episode.oracle_max_steps} steps"


def in_tiers() -> Iterator[object]:
    """Every task and level; only the first level of each task is in the fast tier."""
    for task, level in EVERYWHERE:
        is_first = level == task_spec(task).levels[0]
        yield pytest.param(task, level, marks=() if is_first else pytest.mark.slow)


@pytest.mark.parametrize(("task", "level"), list(in_tiers()))
def test_the_oracle_solves_every_task(task: str, level: str) -> None:
    env = TabletopEnv(task, level=level, domain="eval")
    num_seeds = 1 if level in PUBLISHED_LEVELS else 2  # `test_played_digests.py` plays the others
    assert {seed: result for seed in range(num_seeds) if (result := play(env, seed)) != "success"} == {}


if __name__ == "__main__":
    for task, level in EVERYWHERE:
        env = TabletopEnv(task, level=level, assets=sys.argv[2] if len(sys.argv) > 2 else "procedural")
        results = collections.Counter(play(env, seed) for seed in range(int(sys.argv[1])))
        sys.stdout.write(f"{task} {level}: {dict(results)}\n")
        sys.stdout.flush()
