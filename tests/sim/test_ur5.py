"""Arm kinematics: published examples, round trips, limits of reach."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openvima.errors import ActionError
from openvima.sim import ur5

EXAMPLES = [
    ((0.5, 0.0, 0.32, 0.0), (-3.36166, -1.56815, 1.54739, -1.55004, -1.57080, -0.22007)),
    ((0.5, 0.0, 0.02, 0.0), (-3.36166, -1.29760, 2.07845, -2.35164, -1.57080, -0.22007)),
    ((0.25, 0.5, 0.32, 0.0), (-2.23096, -1.42544, 1.39325, -1.53861, -1.57080, 0.91063)),
    ((0.5, 0.2, 0.3, 0.8), (-2.96519, -1.47521, 1.50049, -1.59609, -1.57080, -0.62359)),
]


def assert_reaches(x: float, y: float, z: float, yaw_rad: float) -> None:
    joints = ur5.inverse(x, y, z, yaw_rad)
    tip, asked = ur5.forward(joints), ur5.tool_pose(x, y, z, yaw_rad)
    np.testing.assert_allclose(tip.position, asked.position, atol=1e-6)
    np.testing.assert_allclose(tip.matrix(), asked.matrix(), atol=1e-6)
    assert (np.abs(joints) <= ur5.JOINT_LIMITS).all()


def test_at_home_the_tip_is_where_the_benchmark_has_it() -> None:
    flange, tip = ur5.link_frames(ur5.HOME)[-1], ur5.forward(ur5.HOME)
    np.testing.assert_allclose(flange.position, (0.48690, 0.10915, 0.43186), atol=1e-5)
    np.testing.assert_allclose(tip.position, (0.48690, 0.10915, 0.31186), atol=1e-5)
    np.testing.assert_allclose(tip.matrix()[:, 2], (0, 0, -1), atol=1e-9)  # the tool points down


@pytest.mark.parametrize(("target", "joints"), EXAMPLES)
def test_inverse_gives_the_published_joints(target, joints) -> None:
    np.testing.assert_allclose(ur5.inverse(*target), joints, atol=1e-5)


def test_forward_undoes_inverse_all_over_the_workspace() -> None:
    for x in np.linspace(0.25, 0.75, 11):
        for y in np.linspace(-0.5, 0.5, 21):
            for z in (0.0, 0.05, 0.15, 0.32):
                assert_reaches(x, y, min(z, ur5.highest_tip_z(x, y) - 1e-9), 0.7)


@given(st.floats(0.2, 0.75), st.floats(-0.5, 0.5), st.floats(0.0, 0.05), st.floats(-math.pi, math.pi))
def test_forward_undoes_inverse_anywhere_low(x, y, z, yaw_rad) -> None:
    assert_reaches(x, y, z, yaw_rad)


def test_a_point_beyond_reach_is_refused_and_the_limit_is_named() -> None:
    assert ur5.highest_tip_z(0.75, 0.5) == pytest.approx(0.0533, abs=1e-4)
    with pytest.raises(ActionError, match=r"0\.8173 m.*highest_tip_z"):
        ur5.inverse(0.75, 0.5, 0.06, 0.0)
    with pytest.raises(ActionError):
        ur5.inverse(0.05, 0.0, 0.1, 0.0)
    assert ur5.highest_tip_z(1.5, 0.0) == -math.inf
