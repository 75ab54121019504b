"""The arm as recordings and views show it."""

import itertools
import math

import numpy as np
import pytest

from openvima.render import Rasteriser
from openvima.scene import Action
from openvima.sim import World, ur5
from openvima.sim.arm_view import arm_drawables
from openvima.sim.primitive_state import FREE_SPEED
from sim_cases import ASSETS, table

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
    world.execute(action, record=lambda *frame: frames.append(frame), frames_per_second=30)
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
def test_the_arm_has_its_ids_and_ends_at_its_tool(end_effector, ids, lowest) -> None:
    drawables = arm_drawables(ur5.inverse(0.5, 0.0, 0.02, 0.3), end_effector)
    assert {drawable.id for drawable in drawables} == ids
    vertices = np.concatenate([drawable.mesh.vertices for drawable in drawables])
    assert len(vertices) < 2500
    tool = np.concatenate([drawable.mesh.vertices for drawable in drawables if drawable.id > 2])
    assert tool[..., 2].min() == pytest.approx(lowest, abs=1e-4)


@pytest.mark.parametrize("end_effector", ["suction", "spatula"])
def test_all_faces_look_outwards(end_effector) -> None:
    for drawable in arm_drawables(ur5.HOME, end_effector):
        a, b, c = np.moveaxis(drawable.mesh.vertices, 1, 0)
        facing = np.cross(b - a, c - a)
        assert (np.einsum("ij,ikj->ik", facing, drawable.mesh.normals) > 0).all()
        np.testing.assert_allclose(np.linalg.norm(drawable.mesh.normals, axis=-1), 1.0, atol=1e-9)


def test_the_arm_shows_in_both_views() -> None:
    scene = table(("block", 0.5, 0.0, 0.0))
    arm = arm_drawables(ur5.inverse(0.5, 0.2, 0.2, 0.0), "suction")
    for image in Rasteriser(ASSETS).scene(scene, extra=arm).values():
        assert 2 in image.segm
