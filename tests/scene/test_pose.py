"""Poses are rigid transforms."""

import math

import numpy as np
import pytest
from hypothesis import given

from openvima.errors import SceneError
from openvima.scene import Pose, angle_difference
from openvima.scene.scene import normalised
from strategies import angles, flat_poses, poses, vectors


def assert_close(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(a.position, b.position, atol=1e-9)
    np.testing.assert_allclose(a.matrix(), b.matrix(), atol=1e-9)  # q and −q are the same rotation


@given(poses)
def test_a_pose_times_its_inverse_is_the_identity(pose: Pose) -> None:
    assert_close(pose @ pose.inverse(), Pose((0.0, 0.0, 0.0)))
    assert_close(pose.inverse() @ pose, Pose((0.0, 0.0, 0.0)))


@given(poses, poses, vectors)
@pytest.mark.slow
def test_chained_poses_map_points_one_after_the_other(a: Pose, b: Pose, point: tuple[float, ...]) -> None:
    np.testing.assert_allclose((a @ b).transform(np.array(point)), a.transform(b.transform(point)), atol=1e-9)


@given(poses)
def test_the_rotation_matrix_is_orthonormal_and_right_handed(pose: Pose) -> None:
    matrix = pose.matrix()
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(matrix) == pytest.approx(1.0)


@given(flat_poses, angles)
def test_turning_on_the_spot_adds_to_the_heading_and_keeps_the_place(pose: Pose, turn: float) -> None:
    turned = pose.rotated(turn)
    assert turned.position == pose.position
    assert angle_difference(turned.yaw_rad, pose.yaw_rad + turn) < 1e-9


def test_the_heading_is_counter_clockwise_seen_from_above() -> None:
    x_axis = Pose.planar(0, 0, math.pi / 2).transform(np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(x_axis, [0, 1, 0], atol=1e-12)


def test_the_heading_of_a_tilted_body_is_that_of_the_static_zxy_angles() -> None:
    # R = Ry(0.3) Rx(-0.2) Rz(0.7), written out by hand.
    about_y = Pose((0, 0, 0), (0.0, math.sin(0.15), 0.0, math.cos(0.15)))
    about_x = Pose((0, 0, 0), (math.sin(-0.1), 0.0, 0.0, math.cos(-0.1)))
    assert (about_y @ about_x @ Pose.planar(0, 0, 0.7)).yaw_rad == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("a_deg", "b_deg", "period_deg", "expected_deg"),
    [
        (0, 350, 360, 10),
        (-179, 179, 360, 2),
        (0, 80, 90, 10),
        (0, 180, 360, 180),
        (10, 130, 120, 0),
        (0, 77, 0, 0),
    ],
)
def test_angles_differ_by_the_shorter_way_round(
    a_deg: float, b_deg: float, period_deg: float, expected_deg: float
) -> None:
    difference = angle_difference(*(math.radians(v) for v in (a_deg, b_deg, period_deg)))
    assert math.degrees(difference) == pytest.approx(expected_deg, abs=1e-9)


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (math.inf, 0, 0, 1)])
def test_a_quaternion_without_direction_is_refused(quaternion: tuple[float, float, float, float]) -> None:
    with pytest.raises(SceneError, match="no direction"):
        normalised(quaternion)
