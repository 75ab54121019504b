"""Picking and placing: what is lifted, where it goes, what happens to the others."""

import itertools
import math

import numpy as np
import pytest

from openvima.render import Rasteriser
from openvima.scene import Action, Pose
from openvima.sim import World, ur5
from openvima.sim.arm_view import arm_drawables
from openvima.sim.bodies import Bodies
from openvima.sim.primitive_state import FREE_SPEED, SETTLE_LIMIT_TICKS
from openvima.sim.world import body_under_probe
from sim_cases import ASSETS, table


def assert_same_pose(pose: Pose, other: Pose, tolerance_m: float = 1e-6) -> None:
    assert math.dist(pose.position, other.position) < tolerance_m
    assert np.abs(pose.matrix() - other.matrix()).max() < 1e-5


def test_an_object_moves_exactly_with_the_tool() -> None:
    scene = table(("letter A", 0.4, -0.2, 0.5), ("ring", 0.6, 0.3, 0.0))
    world = World(scene, ASSETS)
    pick, place, turn_rad = (0.41, -0.21), (0.55, 0.1), 1.2
    execution = world.execute(Action.planar(pick, place, turn_rad))
    assert execution.grasped == 5
    assert execution.num_ticks < SETTLE_LIMIT_TICKS
    expected = Pose.planar(*place, turn_rad) @ Pose.planar(*pick).inverse() @ scene[5].pose
    assert_same_pose(world.scene[5].pose, expected)
    assert world.scene[6] == scene[6]


def test_only_the_difference_of_the_two_yaws_turns_the_object() -> None:
    scene = table(("letter A", 0.4, -0.2, 0.5))
    world = World(scene, ASSETS)
    quaternions = [Pose.planar(0, 0, yaw).quaternion for yaw in (0.7, 1.0)]
    world.execute(Action((0.4, -0.2), (0.4, -0.2), quaternions[0], quaternions[1]))
    assert_same_pose(world.scene[5].pose, scene[5].pose.rotated(0.3))


def test_a_failed_pick_leaves_everything_where_it_was() -> None:
    scene = table(("letter A", 0.4, -0.2, 0.5), fixed=(("container", 0.6, 0.2, 0.3),))
    world = World(scene, ASSETS)
    for pick in ((0.5, 0.0), (0.6, 0.2)):  # the table, the fixed container
        execution = world.execute(Action.planar(pick, (0.4, -0.2)))
        assert execution.grasped is None
        assert world.scene == scene


@pytest.mark.parametrize(("beside_m", "is_caught"), [(-0.002, True), (0.002, True), (0.006, False)])
def test_the_cup_catches_what_is_a_little_beside_it(beside_m, is_caught) -> None:
    bodies = Bodies(table(("block", 0.5, 0.0, 0.0)), ASSETS)
    index, z = body_under_probe(bodies, 0.5 + 0.035 + beside_m, 0.0)
    assert index == (0 if is_caught else None)
    assert z == pytest.approx(0.069 if is_caught else -0.001, abs=1e-3)


@pytest.mark.parametrize(("beside_m", "is_caught"), [(0.0015, True), (0.0025, False)])
def test_the_cup_catches_what_is_close_beside_it_in_a_container(beside_m, is_caught) -> None:
    scene = table(("block", 0.5, 0.0, 0.0), fixed=(("container", 0.5, 0.0, 0.0),))
    action = Action.planar((0.5 + 0.035 + beside_m, 0.0), (0.6, 0.3))
    assert World(scene, ASSETS).execute(action).grasped == (5 if is_caught else None)


def test_a_block_above_the_floor_is_caught_at_any_height_and_tilt() -> None:
    rng = np.random.default_rng(0)
    scene = table(("block", 0.5, 0.0, 0.0))
    for _ in range(100):
        tilt = Pose((0, 0, 0), (*rng.normal(0, 10.0 ** rng.uniform(-12, -1), size=2).tolist(), 0.0, 1.0))
        pose = scene[5].pose.moved(dz=rng.uniform(0.001, 0.05)) @ tilt
        bodies = Bodies(scene.with_poses({5: pose}), ASSETS)
        x, y = rng.uniform(-0.025, 0.025, size=2).tolist()
        index, z = body_under_probe(bodies, 0.5 + x, y)
        assert index == 0 and z == pytest.approx(pose.z + 0.035, abs=0.02)


def test_an_object_is_set_down_on_another_and_picked_from_there() -> None:
    scene = table(("block", 0.5, 0.0, 0.0), ("letter A", 0.4, -0.2, 0.0))
    world = World(scene, ASSETS)
    assert world.execute(Action.planar((0.4, -0.2), (0.5, 0.0))).grasped == 6
    assert world.scene[6].pose.z == pytest.approx(0.070, abs=1e-3)
    assert world.execute(Action.planar((0.5, 0.0), (0.4, 0.3))).grasped == 6
    assert world.scene[6].pose.z == pytest.approx(0.0, abs=3e-4)
    assert world.scene[5].pose.planar_distance(scene[5].pose) < 1e-3


def test_a_body_falls_as_soon_as_the_one_below_it_is_taken() -> None:
    scene = table(("pan", 0.5, 0.0, 0.0), ("small block", 0.5, 0.0, 0.0))
    scene = scene.with_poses({6: scene[6].pose.moved(dz=0.045)})
    world = World(scene, ASSETS)
    seen = []
    execution = world.execute(  # the pan is taken by its handle and put back: now it stands on the block
        Action.planar((0.62, 0.0), (0.62, 0.0)), monitor=seen.append
    )
    assert execution.grasped == 5
    assert any(now[5].pose.z > 0.2 and now[6].pose.z < 0.03 for now in seen)
    assert world.scene[6].pose.z == pytest.approx(0.014, abs=2e-3)
    assert world.scene[5].pose.z > 0.02


def test_what_lay_tilted_is_not_left_standing_on_its_edge() -> None:
    scene = table(("letter A", 0.5, 0.0, 0.0), fixed=(("shorter block", 0.55, 0.0, 0.0),))
    leaning = Pose((0.5, 0.0, 0.012), (0.0, -0.1, 0.0, math.sqrt(1 - 0.01)))
    world = World(scene.with_poses({5: leaning}), ASSETS)
    world.execute(Action.planar((0.3, 0.4), (0.3, 0.4)))  # it settles against the block
    assert world.scene[5].pose.matrix()[2, 2] < 0.999
    x, y, _ = world.scene[5].pose.position
    assert world.execute(Action.planar((x, y), (0.4, -0.3))).grasped == 5
    assert world.scene[5].pose.matrix()[2, 2] > 0.99999


def test_a_ring_picked_in_its_hole_and_put_into_a_container_lies_on_its_floor() -> None:
    scene = table(("ring", 0.4, -0.2, 0.0), fixed=(("container", 0.6, 0.2, 0.3),))
    world = World(scene, ASSETS)
    assert world.execute(Action.planar((0.4, -0.2), (0.6, 0.2))).grasped == 5
    assert world.scene[5].pose.z == pytest.approx(0.002, abs=5e-4)  # 1.0 mm slab top and 1 mm margin
    assert world.scene[5].pose.planar_distance(Pose.planar(0.6, 0.2)) < 5e-4


def test_an_object_that_meets_a_neighbour_on_its_way_down_is_let_go_there() -> None:
    scene = table(("block", 0.4, -0.2, 0.0), ("block", 0.6, 0.2, 0.0))
    world = World(scene, ASSETS)
    world.execute(Action.planar((0.4, -0.2), (0.6, 0.265)))  # overlaps the neighbour by 5 mm
    assert world.scene[5].pose.y > 0.265  # it slid off
    assert world.scene[6].pose.planar_distance(scene[6].pose) < 0.02


def test_hovering_bodies_come_to_rest_during_the_first_action() -> None:
    scene = table(("letter A", 0.4, -0.2, 0.0), ("block", 0.6, 0.2, 0.0))
    lifted = scene.with_poses({i: scene[i].pose.moved(dz=0.016) for i in (5, 6)})
    world = World(lifted, ASSETS, compat=True)
    assert world.scene == lifted
    world.execute(Action.planar((0.5, 0.0), (0.5, 0.0)))
    for i in (5, 6):
        assert world.scene[i].pose.z == pytest.approx(scene[i].pose.z, abs=1e-4)
        assert world.scene[i].pose.planar_distance(scene[i].pose) < 1e-4


def test_far_corners_are_picked_and_placed_though_the_arm_cannot_hover_high_there() -> None:
    scene = table(("block", 0.75, 0.5, 0.0))
    world = World(scene, ASSETS)
    assert world.execute(Action.planar((0.75, 0.5), (0.75, -0.5))).grasped == 5
    assert world.scene[5].pose.planar_distance(Pose.planar(0.75, -0.5)) < 1e-6


def test_the_joint_path_leads_from_where_the_arm_was_to_where_it_is() -> None:
    world = World(table(("block", 0.5, 0.0, 0.0)), ASSETS)
    home = world.joints
    first = world.execute(Action.planar((0.5, 0.0), (0.6, 0.1)))
    assert first.joint_path.dtype == np.float32
    np.testing.assert_array_equal(first.joint_path[0], home.astype(np.float32))
    np.testing.assert_array_equal(first.joint_path[-1], world.joints.astype(np.float32))
    second = world.execute(Action.planar((0.5, 0.0), (0.6, 0.1)))
    np.testing.assert_array_equal(second.joint_path[0], first.joint_path[-1])


def test_a_body_on_edge_that_leans_on_nothing_falls_over() -> None:
    scene = table(("letter A", 0.5, 0.0, 0.0))
    lean = Pose((0.5, 0.0, 0.0), (math.sin(0.65), 0.0, 0.0, math.cos(0.65)))  # 75 degrees up
    lowest = Bodies(scene, ASSETS).lowest_z(0, lean.quaternion)
    world = World(scene.with_poses({5: lean.moved(dz=-0.001 - lowest)}), ASSETS)
    world.execute(Action.planar((0.3, 0.4), (0.3, 0.3)))  # elsewhere
    assert abs(world.scene[5].pose.matrix()[2, 2]) > 0.99
    assert world.scene[5].pose.z < 0.035


CASES = [
    (
        table(("letter A", 0.4, -0.2, 0.5), ("block", 0.6, 0.2, 0.0)),
        Action.planar((0.4, -0.2), (0.6, 0.2), 1.0),
    ),
    (
        table(("small block", 0.6, 0.0, 0.3), ("small block", 0.5, 0.01, 0.0), end_effector="spatula"),
        Action.planar((0.6, 0.0), (0.4, 0.0)),
    ),
]


@pytest.mark.parametrize(("scene", "action"), CASES)
def test_recording_and_watching_change_nothing(scene, action) -> None:
    plain, filmed = World(scene, ASSETS), World(scene, ASSETS)
    one = plain.execute(action)
    other = filmed.execute(action, record=lambda *_: None, monitor=lambda _: None)
    assert plain.scene == filmed.scene
    assert one.num_ticks == other.num_ticks
    np.testing.assert_array_equal(one.joint_path, other.joint_path)


@pytest.mark.parametrize(("scene", "action"), CASES)
def test_from_frame_to_frame_nothing_jumps(scene, action) -> None:
    frames = []
    world = World(scene, ASSETS)
    world.execute(action, record=lambda *frame: frames.append(frame))
    assert 50 < len(frames) < 200
    joints = np.array([ur5.HOME, *(frame[1] for frame in frames), world.joints])
    assert np.linalg.norm(np.diff(joints, axis=0), axis=1).max() < 1.5 * FREE_SPEED / 30
    scenes = [scene, *(frame[0] for frame in frames), world.scene]
    for before, after in itertools.pairwise(scenes):
        for p, q in zip(before.placements, after.placements, strict=True):
            assert math.dist(p.pose.position, q.pose.position) < 0.06


def test_a_carried_object_keeps_its_place_below_the_tip() -> None:
    scene, action = CASES[0]
    offsets = []

    def record(now, joints) -> None:
        if now[5].pose.z > 0.1:
            offsets.append(ur5.forward(joints).inverse() @ now[5].pose)

    World(scene, ASSETS).execute(action, record=record)
    assert len(offsets) > 20
    for offset in offsets[1:]:
        np.testing.assert_allclose(offset.position, offsets[0].position, atol=1e-9)


@pytest.mark.parametrize(
    ("end_effector", "ids", "lowest"), [("suction", {2, 3, 4}, 0.017), ("spatula", {2, 3}, 0.015)]
)
def test_the_arm_has_its_ids_looks_outwards_and_ends_at_its_tool(end_effector, ids, lowest) -> None:
    drawables = arm_drawables(ur5.inverse(0.5, 0.0, 0.02, 0.3), end_effector)
    assert {drawable.id for drawable in drawables} == ids
    vertices = np.concatenate([drawable.mesh.vertices for drawable in drawables])
    assert len(vertices) < 2500
    tool = np.concatenate([drawable.mesh.vertices for drawable in drawables if drawable.id > 2])
    assert tool[..., 2].min() == pytest.approx(lowest, abs=1e-4)
    a, b, c = np.moveaxis(vertices, 1, 0)
    normals = np.concatenate([drawable.mesh.normals for drawable in drawables])
    assert (np.einsum("ij,ikj->ik", np.cross(b - a, c - a), normals) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-9)
    for image in Rasteriser(ASSETS).scene(table(("block", 0.5, 0.2, 0.0)), extra=drawables).values():
        assert 2 in image.segm
