"""Any valid action in any scene: no crash, no NaN, nothing lost, no endless run; always the same bytes."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from openvima.scene import Action
from openvima.sim import World
from sim_cases import ASSETS, random_action, random_table, table
from task_cases import full_repr

SEEDS = range(12)
NUM_ACTIONS = 4


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.slow
def test_random_actions_never_lose_a_body(seed) -> None:
    rng = np.random.default_rng(seed)
    world = World(random_table(rng, ("suction", "spatula")[seed % 2]), ASSETS)
    start = world.scene
    for _ in range(NUM_ACTIONS):
        action = random_action(rng, world.scene)
        execution = world.execute(action)
        assert execution.num_ticks <= 4000, action
        assert np.isfinite(execution.joint_path).all()
        for before, now in zip(start.placements, world.scene.placements, strict=True):
            assert np.isfinite([*now.pose.position, *now.pose.quaternion]).all(), (action, now)
            if before.fixed:
                assert now == before
            else:
                assert -0.03 < now.pose.z < 0.6, (action, now)
                assert now.pose.planar_distance(before.pose) < 3.0, (action, now)


@pytest.mark.slow
def test_a_heap_of_bodies_in_one_another_comes_apart() -> None:
    names = ("bowl", "container", "letter A") * 3
    bodies = [(name, 0.5 + 0.01 * i, 0.01 * i, 0.3 * i) for i, name in enumerate(names)]
    world = World(table(*bodies), ASSETS)
    world.execute(Action.planar((0.5, 0.0), (0.6, 0.2)))
    assert all(abs(placement.pose.z) < 0.6 for placement in world.scene.placements)


def digest() -> str:
    """Hash of everything that some primitives in some scenes give."""
    content = hashlib.sha256()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        world = World(random_table(rng, ("suction", "spatula")[seed % 2]), ASSETS)
        for _ in range(3):
            execution = world.execute(random_action(rng, world.scene))
            content.update(full_repr((world.scene, execution.grasped, execution.num_ticks)).encode())
            content.update(execution.joint_path.tobytes())
    return content.hexdigest()


@pytest.mark.slow
def test_another_process_or_processor_gives_the_same_bytes() -> None:
    """The other one multiplies matrices as an early 64-bit processor would, if NumPy's library can."""
    tests = Path(__file__).parents[1]
    code = f"""
import runpy, sys
sys.path.insert(0, {str(tests)!r})
print(runpy.run_path({__file__!r})["digest"]())
"""
    other = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "OPENBLAS_CORETYPE": "Prescott"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert other.stdout.strip() == digest()


def test_worlds_do_not_influence_each_other() -> None:
    def play(interleaved: bool) -> list:
        rng = np.random.default_rng(3)
        world = World(random_table(rng, "spatula"), ASSETS)
        other = World(random_table(np.random.default_rng(5), "suction"), ASSETS)
        scenes = []
        for _ in range(3):
            world.execute(random_action(rng, world.scene))
            if interleaved:
                other.execute(random_action(np.random.default_rng(1), other.scene))
            scenes.append(world.scene)
        return scenes

    assert play(False) == play(True)
