"""Bodies, and robustness of the simulation."""

import hashlib
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from openvima.scene import Action, Pose, Scene
from openvima.sim import World
from openvima.sim.bodies import Bodies
from openvima.sim.model import body_shape
from openvima.sim.primitive_state import SETTLE_LIMIT_TICKS, Settling, is_at_rest
from sim_cases import ALL_OBJECTS, ASSETS, random_table, table
from task_cases import full_repr, random_action


@pytest.mark.parametrize("name", ALL_OBJECTS)
def test_a_body_laid_on_the_table_stays_there_for_seconds(name) -> None:
    scene = table((name, 0.5, 0.1, 0.4))
    bodies = Bodies(scene, ASSETS)
    bodies.tick(3 * 240)
    before, after = scene.placements[0].pose, bodies.pose(0)
    tolerance_m = 5e-4 if name == "pan" else 1e-4  # the pan's hull rocks onto its rim
    assert math.dist(before.position, after.position) < tolerance_m
    assert abs(before.yaw_rad - after.yaw_rad) < 1e-4


@pytest.mark.parametrize("name", ALL_OBJECTS)
def test_a_dropped_body_comes_to_lie_at_its_rest_height(name) -> None:
    scene = table((name, 0.5, 0.0, 0.3))
    (placement,) = scene.placements
    tilted = Pose((0.5, 0.0, placement.pose.z + 0.02), (0.02, 0.03, 0.0, math.sqrt(1 - 0.0013)))
    bodies = Bodies(Scene((placement.at(tilted),)), ASSETS)
    settling = Settling(bodies)
    while not settling.is_over:
        settling.run()
    assert settling.num_ticks < SETTLE_LIMIT_TICKS
    assert bodies.pose(0).z == pytest.approx(placement.pose.z, abs=2e-4)


def test_inertia_is_three_times_that_of_the_bounding_box() -> None:
    def inertia(name: str) -> tuple[float, ...]:
        (placement,) = table((name, 0.5, 0.0, 0.0)).placements
        return body_shape(name, ASSETS.geometry(name, placement.size), False).inertia

    np.testing.assert_allclose(inertia("block"), [2.45e-5] * 3, rtol=1e-3)
    np.testing.assert_allclose(inertia("small block"), [4.5e-7] * 3, rtol=1e-3)
    np.testing.assert_allclose(inertia("ring"), [2.909e-4, 2.909e-4, 5.202e-4], rtol=0.01)


@pytest.mark.parametrize(
    ("sliding", "ground", "friction"),
    [
        ("small block", None, 0.5),
        ("block", None, 1.0),
        ("container", None, 0.3),
        ("small block", "shorter block", 0.5),
    ],
)
def test_friction_of_a_pair_is_the_product_of_both(sliding, ground, friction) -> None:
    scene = table((sliding, 0.5, 0.0, 0.0))
    if ground is not None:
        scene = table((sliding, 0.5, 0.0, 0.0), fixed=((ground, 0.5, 0.0, 0.0),))
        base = scene.placements[1].pose.z + 0.015
        scene = scene.with_poses({5: Pose((0.48, 0.0, base + 0.015))})
    bodies = Bodies(scene, ASSETS)
    bodies.tick(60)
    bodies._velocities[0, 0] = speed = 0.2
    bodies.tick(120)
    way = bodies.pose(0).x - scene.placements[0].pose.x
    assert way == pytest.approx(speed**2 / (2 * friction * 9.8), rel=0.12)  # v² / (2 μ g)


def test_bodies_at_rest_need_no_physics_and_others_do() -> None:
    scene = table(("letter A", 0.4, 0.0, 0.0), ("block", 0.6, 0.0, 0.0))
    assert is_at_rest(Bodies(scene, ASSETS))
    assert not is_at_rest(Bodies(scene.with_poses({5: scene[5].pose.moved(dz=0.01)}), ASSETS))
    assert not is_at_rest(Bodies(scene.with_poses({5: scene[6].pose.moved(dz=-0.034)}), ASSETS))


def test_fixed_bodies_do_not_fall() -> None:
    scene = table(fixed=(("container", 0.5, 0.0, 0.0),))
    scene = scene.with_poses({5: scene[5].pose.moved(dz=0.1)})
    bodies = Bodies(scene, ASSETS)
    bodies.tick(100)
    assert bodies.pose(0) == scene[5].pose


SEEDS = range(4)
NUM_ACTIONS = 4


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.slow
def test_random_actions_never_lose_a_body(seed) -> None:
    rng = np.random.default_rng(seed)
    world = World(random_table(rng, ("suction", "spatula")[seed % 2]), ASSETS)
    start = world.scene
    for _ in range(NUM_ACTIONS):
        action = Action.from_arrays(random_action(rng, world.scene))
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


def digest() -> str:
    """Hash of everything that some primitives in some scenes give."""
    content = hashlib.sha256()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        world = World(random_table(rng, ("suction", "spatula")[seed % 2]), ASSETS)
        for _ in range(3):
            execution = world.execute(Action.from_arrays(random_action(rng, world.scene)))
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
