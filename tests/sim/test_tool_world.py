"""The tool moved by commands, and the kinematics of the arm."""

import copy
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openvima.errors import ActionError
from openvima.scene import Action, Pose, Scene
from openvima.scene.action import HIGHEST_TIP_Z_M, MAX_MOVE_M, MAX_TURN_RAD, ToolCommand
from openvima.sim import World, ur5
from openvima.sim.model import FLOOR_Z_M
from openvima.sim.spatula import SWEEP_M_S
from openvima.sim.tool_path import PathFollower, tool_path
from openvima.sim.tool_world import MAX_JOINT_SPEED, ToolWorld
from openvima.sim.ur5 import (
    JOINT_LIMITS,
    PROBE_BELOW_TIP_M,
    SWEEP_TIP_Z_M,
    forward,
    highest_tip_z,
    tool_pose,
)
from sim_cases import ASSETS, random_table, table

ON, OFF = ToolCommand(0, 0, 0, 0, True), ToolCommand(0, 0, 0, 0, False)


def go(world: ToolWorld, x: float, y: float, z: float, *, tool: bool, yaw_rad: float = 0.0) -> None:
    """Command the tool towards a pose until it no longer moves."""
    for _ in range(100):
        pose, before = world.pose, world.pose
        deltas = np.clip((x - pose.x, y - pose.y, z - pose.z), -MAX_MOVE_M, MAX_MOVE_M).tolist()
        turn = float(np.clip(yaw_rad - pose.yaw_rad, -MAX_TURN_RAD, MAX_TURN_RAD))
        world.command(ToolCommand(*deltas, turn, tool))
        if world.pose == before:
            return


def perform(scene: Scene, action: Action) -> tuple[Scene, int]:
    """Follow a primitive to its end; return the final scene and how many manipulations ended."""
    world = ToolWorld(scene, ASSETS)
    follower = PathFollower(tool_path(action, scene.end_effector))
    num_ended = 0
    while (command := follower.next_command(world)) is not None:
        num_ended += world.command(command)
    assert not world.holds
    return world.scene, num_ended


@pytest.mark.parametrize("place", [(0.55, 0.1), (0.6, 0.3)])  # bare table, onto the ring
def test_pick_and_place_by_commands_ends_as_the_primitive_does(place) -> None:
    scene = table(("letter A", 0.4, -0.2, 0.5), ("ring", 0.6, 0.3, 0.0))
    action = Action.planar((0.41, -0.21), place, 1.2)
    world = World(scene, ASSETS)
    world.execute(action)
    final, num_ended = perform(scene, action)
    assert num_ended == 1
    for placement in world.scene.placements:
        pose = final[placement.id].pose
        assert math.dist(pose.position, placement.pose.position) < 2e-4
        assert np.abs(pose.matrix() - placement.pose.matrix()).max() < 5e-3


def test_a_sweep_by_commands_ends_as_the_primitive_does() -> None:
    scene = table(("small block", 0.45, 0.0, 0.2), ("small block", 0.6, 0.3, 0.0), end_effector="spatula")
    action = Action.planar((0.42, 0.0), (0.62, 0.05))
    world = World(scene, ASSETS)
    world.execute(action)
    final, num_ended = perform(scene, action)
    assert num_ended == 1
    assert final[4].pose.planar_distance(world.scene[4].pose) < 5e-3  # by physics throughout
    assert world.scene[4].pose.planar_distance(scene[4].pose) > 0.1
    assert final[5] == scene[5]


def test_the_cup_stops_at_contact_and_a_body_follows_it_in_the_scene() -> None:
    scene = table(("block", 0.5, 0.0, 0.0))
    world = ToolWorld(scene, ASSETS)
    go(world, 0.5, 0.0, 0.0, tool=False)
    assert world.pose.z == pytest.approx(0.069 + 0.003, abs=1e-4)
    assert not world.holds
    world.command(ON)
    assert world.grasped == 5
    go(world, 0.5, 0.1, 0.2, tool=True, yaw_rad=0.4)
    pose = world.scene[5].pose
    assert (pose.y, pose.yaw_rad) == pytest.approx((0.1, 0.4), abs=1e-6)
    assert pose.z - scene[5].pose.z == pytest.approx(world.pose.z - 0.072, abs=1e-3)


def test_a_body_let_go_in_the_air_falls_and_the_manipulation_ends_at_rest() -> None:
    scene = table(("block", 0.5, 0.0, 0.0))
    world = ToolWorld(scene, ASSETS)
    go(world, 0.5, 0.0, 0.0, tool=True)
    go(world, 0.5, 0.0, 0.25, tool=True)
    heights, ended = [], []
    while not any(ended):
        ended.append(world.command(OFF))
        heights.append(world.scene[5].pose.z)
    assert len(heights) > 2
    assert heights[0] > heights[-1] + 0.05
    assert heights[-1] == pytest.approx(scene[5].pose.z, abs=1e-3)


def test_a_held_body_does_not_enter_another_sideways() -> None:
    scene = table(("block", 0.4, 0.0, 0.0), fixed=(("block", 0.4, 0.2, 0.0),))
    world = ToolWorld(scene, ASSETS)
    go(world, 0.4, 0.0, 0.0, tool=True)
    go(world, 0.4, 0.0, 0.09, tool=True)
    go(world, 0.4, 0.2, 0.09, tool=True)
    assert 0.09 < world.scene[5].pose.y < 0.2 - 0.069
    go(world, 0.4, world.pose.y, 0.25, tool=True)  # lifting is free
    go(world, 0.4, 0.2, 0.25, tool=True)
    assert world.pose.y == pytest.approx(0.2, abs=1e-6)


def test_the_spatula_moves_blocks_only_while_it_is_pressed_to_the_table() -> None:
    scene = table(("small block", 0.5, 0.05, 0.0), end_effector="spatula")
    world = ToolWorld(scene, ASSETS)
    go(world, 0.5, 0.0, 0.1, tool=True, yaw_rad=math.pi / 2)
    assert not world.holds  # too high
    go(world, 0.5, 0.1, 0.0, tool=False, yaw_rad=math.pi / 2)
    assert world.scene == scene
    go(world, 0.5, 0.0, 0.0, tool=False, yaw_rad=math.pi / 2)
    world.command(ON)
    assert world.holds
    before = world.pose
    world.command(ToolCommand(0, MAX_MOVE_M, 0.05, 0, True))
    assert world.pose.y - before.y == pytest.approx(SWEEP_M_S / 10)  # slower than the tool in the air
    assert world.pose.z == before.z
    go(world, 0.5, 0.1, 0.0, tool=True, yaw_rad=math.pi / 2)
    assert world.scene[4].pose.y > 0.1


@pytest.mark.parametrize("end_effector", ["suction", "spatula"])
def test_no_commands_exceed_reach_limits_or_speed_of_the_joints(end_effector) -> None:
    rng = np.random.default_rng(3)
    world = ToolWorld(random_table(rng, end_effector), ASSETS)
    for _ in range(60):
        deltas = rng.choice((-1.0, 1.0), 3) * MAX_MOVE_M
        before, joints = world.pose, world.joints
        world.command(ToolCommand(*deltas.tolist(), MAX_TURN_RAD, bool(rng.random() < 0.5)))
        assert (np.abs(world.joints) <= JOINT_LIMITS).all()
        assert (np.abs(world.joints - joints) <= MAX_JOINT_SPEED * 0.1 + 1e-9).all()
        pose = world.pose
        assert max(abs(pose.x - before.x), abs(pose.y - before.y)) <= MAX_MOVE_M + 1e-9
        assert 0.23 - 1e-9 <= pose.x <= 0.77 + 1e-9
        difference = forward(world.joints).matrix() - tool_pose(pose.x, pose.y, pose.z, pose.yaw_rad).matrix()
        assert np.abs(difference).max() < 1e-9


def test_a_copy_in_the_middle_of_a_manipulation_goes_on_equally() -> None:
    world = ToolWorld(table(("block", 0.5, 0.0, 0.0)), ASSETS)
    go(world, 0.5, 0.0, 0.0, tool=True)
    go(world, 0.5, 0.02, 0.15, tool=True)
    world.command(OFF)
    assert world.is_moving
    other = copy.deepcopy(world)
    for _ in range(5):
        assert world.command(OFF) == other.command(OFF)
        assert world.scene == other.scene


def test_bodies_that_hover_at_the_start_settle_first() -> None:
    scene = table(("block", 0.5, 0.0, 0.0))
    hovering = scene.with_poses({5: Pose((0.5, 0.0, 0.2))})
    world = ToolWorld(hovering, ASSETS)
    assert not world.command(OFF)
    assert world.scene[5].pose.z == pytest.approx(scene[5].pose.z, abs=1e-3)


@pytest.mark.parametrize("end_effector", ["suction", "spatula"])
@pytest.mark.parametrize("side", [-1, 1])
def test_the_tool_stops_at_the_rim_of_its_reach_above_its_lowest_height(end_effector, side) -> None:
    lowest = SWEEP_TIP_Z_M if end_effector == "spatula" else FLOOR_Z_M + PROBE_BELOW_TIP_M
    for tool in (False, True):
        for first in ((0, 0, -0.05), (0.05, 0, 0), (0, 0.05 * side, 0), (0.05, 0.05 * side, 0.05)):
            world = ToolWorld(Scene((), end_effector), ASSETS)
            for deltas in (
                first,
                (0.05, 0.05 * side, 0),
                (0.05, 0.01 * side, -0.05),
                (0.01, 0.05 * side, 0.02),
            ):
                for _ in range(20):
                    world.command(ToolCommand(*deltas, 0.0, tool))
                    pose = world.pose
                    assert lowest <= pose.z <= HIGHEST_TIP_Z_M
                    assert pose.z <= highest_tip_z(pose.x, pose.y)
            assert tool or math.hypot(pose.x, pose.y) > 0.9
            world.command(ToolCommand(-0.05, -0.05 * side, 0.0, 0.0, tool))
            assert math.hypot(world.pose.x, world.pose.y) < math.hypot(pose.x, pose.y)  # and leaves it again


def test_a_body_beyond_the_height_of_reach_stops_the_cup() -> None:
    scene = table(("block", 0.74, 0.49, 0.0))
    tall = scene.with_poses({5: Pose((0.74, 0.49, 0.08))})
    world = ToolWorld(tall, ASSETS)
    world._is_settled = True  # it stays in the air
    go(world, 0.6, 0.49, 0.35, tool=False)
    go(world, 0.77, 0.52, 0.35, tool=False)
    go(world, 0.77, 0.40, 0.35, tool=False)
    for deltas in ((0.01, 0.05, 0.05), (-0.05, 0.05, 0.0), (0.03, 0.0, 0.05), (0.0, -0.05, 0.05)):
        for _ in range(10):
            world.command(ToolCommand(*deltas, 0.0, False))
            assert world.pose.z <= highest_tip_z(world.pose.x, world.pose.y)


EXAMPLES = [
    ((0.5, 0.0, 0.32, 0.0), (-3.36166, -1.56815, 1.54739, -1.55004, -1.57080, -0.22007)),
    ((0.25, 0.5, 0.32, 0.0), (-2.23096, -1.42544, 1.39325, -1.53861, -1.57080, 0.91063)),
    ((0.5, 0.2, 0.3, 0.8), (-2.96519, -1.47521, 1.50049, -1.59609, -1.57080, -0.62359)),
]


def test_at_home_the_tip_is_where_the_benchmark_has_it() -> None:
    flange, tip = ur5.link_frames(ur5.HOME)[-1], ur5.forward(ur5.HOME)
    np.testing.assert_allclose(flange.position, (0.48690, 0.10915, 0.43186), atol=1e-5)
    np.testing.assert_allclose(tip.position, (0.48690, 0.10915, 0.31186), atol=1e-5)
    np.testing.assert_allclose(tip.matrix()[:, 2], (0, 0, -1), atol=1e-9)  # the tool points down


@pytest.mark.parametrize(("target", "joints"), EXAMPLES)
def test_inverse_gives_the_published_joints(target, joints) -> None:
    np.testing.assert_allclose(ur5.inverse(*target), joints, atol=1e-5)


@given(st.floats(0.2, 0.75), st.floats(-0.5, 0.5), st.floats(0.0, 0.32), st.floats(-math.pi, math.pi))
def test_forward_undoes_inverse_anywhere(x, y, z, yaw_rad) -> None:
    z = min(z, ur5.highest_tip_z(x, y) - 1e-9)
    joints = ur5.inverse(x, y, z, yaw_rad)
    tip, asked = ur5.forward(joints), ur5.tool_pose(x, y, z, yaw_rad)
    np.testing.assert_allclose(tip.position, asked.position, atol=1e-6)
    np.testing.assert_allclose(tip.matrix(), asked.matrix(), atol=1e-6)
    assert (np.abs(joints) <= ur5.JOINT_LIMITS).all()


def test_a_point_beyond_reach_is_refused_and_the_limit_is_named() -> None:
    assert ur5.highest_tip_z(0.75, 0.5) == pytest.approx(0.0533, abs=1e-4)
    with pytest.raises(ActionError, match=r"0\.8173 m.*highest_tip_z"):
        ur5.inverse(0.75, 0.5, 0.06, 0.0)
    with pytest.raises(ActionError):
        ur5.inverse(0.05, 0.0, 0.1, 0.0)
    assert ur5.highest_tip_z(1.5, 0.0) == -math.inf
