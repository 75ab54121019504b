"""The arm as it is drawn in films."""

import numpy as np
import pytest

from openvima.render import Rasteriser
from openvima.sim import ur5
from openvima.sim.arm_view import arm_drawables
from sim_cases import ASSETS, table


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
