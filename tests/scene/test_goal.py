"""Goals and constraints are strict and see blocks as the benchmark does."""

import math

import pytest

from openvima.scene import (
    AtPose,
    InZone,
    NeverTouches,
    Placement,
    Pose,
    Scene,
    Tolerance,
    Zone,
    block_points,
)

BLOCK_SIZE = (0.03, 0.03, 0.03)


def scene_with_block(pose: Pose) -> Scene:
    return Scene((Placement(4, "small block", "red", BLOCK_SIZE, pose),), "spatula")


@pytest.mark.parametrize(("distance", "met"), [(0.0, True), (0.0999, True), (0.1, False), (0.1001, False)])
def test_the_position_tolerance_is_strict(distance: float, met: bool) -> None:
    tolerance = Tolerance(position_m=0.1)
    assert tolerance.accepts(Pose.planar(distance, 0.0), Pose.planar(0.0, 0.0)) is met


@pytest.mark.parametrize(("error_deg", "met"), [(0, True), (14.5, True), (-14.5, True), (15.5, False)])
def test_the_yaw_tolerance_holds_across_the_wrap(error_deg: float, met: bool) -> None:
    tolerance = Tolerance(position_m=0.1, yaw_rad=math.radians(15))
    target = Pose.planar(0, 0, math.radians(178))
    assert tolerance.accepts(target.rotated(math.radians(error_deg)), target) is met


def test_height_does_not_count() -> None:
    assert Tolerance(0.1).accepts(Pose.planar(0, 0, z=0.5), Pose.planar(0, 0))


def test_symmetric_shapes_match_at_any_of_their_headings() -> None:
    goal = AtPose(4, Pose.planar(0.5, 0), Tolerance(0.1, math.radians(15)), symmetry_rad=math.pi / 2)
    assert goal.is_met(scene_with_block(Pose.planar(0.5, 0, math.radians(80))))
    assert not goal.is_met(scene_with_block(Pose.planar(0.5, 0, math.radians(45))))


def test_a_block_is_eight_points_that_miss_its_upper_edges() -> None:
    points = block_points(Pose.planar(0.5, 0.1, z=0.014))
    assert len(points) == 8
    assert min(x for x, _, _ in points) == pytest.approx(0.485)
    assert max(x for x, _, _ in points) == pytest.approx(0.505)
    assert max(z for _, _, z in points) == pytest.approx(0.019)


@pytest.mark.parametrize(
    ("x", "inside"), [(0.5, True), (0.5451, False), (0.5449, True), (0.4651, True), (0.4649, False)]
)
def test_a_block_is_in_a_zone_only_with_all_its_points(x: float, inside: bool) -> None:
    goal = InZone(4, Zone(0.5, 0.0, 0.1, 0.1))  # x from 0.45 to 0.55; points from x − 0.015 to x + 0.005
    assert goal.is_met(scene_with_block(Pose.planar(x, 0.0))) is inside


@pytest.mark.parametrize(("x", "touches"), [(0.5349, True), (0.5351, False)])
def test_a_block_touches_a_line_with_one_point(x: float, touches: bool) -> None:
    line = NeverTouches((4,), Zone(0.5, 0.0, 0.04, 0.3), "line")
    assert line.is_met(scene_with_block(Pose.planar(x, 0.0))) is not touches


def test_a_zone_ends_below_a_height_of_30_centimetres() -> None:
    zone = Zone(0.5, 0.0, 0.1, 0.1)
    assert zone.contains((0.5, 0.0, 0.299))
    assert not zone.contains((0.5, 0.0, 0.3))
