"""Rectangles on the table know when they come near one another."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from openvima.scene import Zone
from openvima.tasks.pushes import Rectangle

rectangles = st.builds(
    Rectangle,
    st.floats(-0.1, 0.1),
    st.floats(-0.1, 0.1),
    st.floats(-4, 4),
    st.floats(0.005, 0.05),
    st.floats(0.005, 0.05),
)


def grid(rectangle: Rectangle) -> list[tuple[float, float]]:
    c, s = math.cos(rectangle.yaw_rad), math.sin(rectangle.yaw_rad)
    steps = [-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0]
    local = [(rectangle.half_x * i, rectangle.half_y * j) for i in steps for j in steps]
    return [(rectangle.x + c * u - s * v, rectangle.y + s * u + c * v) for u, v in local]


def contains(rectangle: Rectangle, point: tuple[float, float]) -> bool:
    dx, dy = point[0] - rectangle.x, point[1] - rectangle.y
    c, s = math.cos(rectangle.yaw_rad), math.sin(rectangle.yaw_rad)
    return abs(c * dx + s * dy) < rectangle.half_x and abs(c * dy - s * dx) < rectangle.half_y


@given(rectangles, rectangles)
def test_rectangles_that_share_a_point_are_near(a: Rectangle, b: Rectangle) -> None:
    if any(contains(a, point) for point in grid(b)) or any(contains(b, point) for point in grid(a)):
        assert a.comes_near(b) and b.comes_near(a)


@given(rectangles, rectangles)
def test_rectangles_with_a_gap_are_not_near(a: Rectangle, b: Rectangle) -> None:
    if not a.comes_near(b):
        assert not any(contains(a, point) for point in grid(b))


@pytest.mark.parametrize(("x", "near"), [(0.0311, False), (0.0309, True), (0.02, True)])
def test_the_margin_counts(x: float, near: bool) -> None:
    a, b = Rectangle(0, 0, 0, 0.015, 0.015), Rectangle(x, 0.01, math.pi / 2, 0.015, 0.015)
    assert a.comes_near(b, 0.001) is near


def test_a_turned_square_reaches_farther() -> None:
    a, b = Rectangle(0, 0, 0, 0.015, 0.015), Rectangle(0.035, 0, 0, 0.015, 0.015)
    assert not a.comes_near(b)
    assert a.comes_near(Rectangle(0.035, 0, math.pi / 4, 0.015, 0.015))


def test_the_box_around_a_turned_square_reaches_farther_than_the_square() -> None:
    spatula = Rectangle(0, 0, 0, 0.0025, 0.025)
    turned = Rectangle(0.02, 0.042, math.pi / 4, 0.015, 0.015)
    assert spatula.meets_box_around(turned) and not spatula.comes_near(turned)
    assert not spatula.meets_box_around(Rectangle(0.02, 0.047, math.pi / 4, 0.015, 0.015))


def test_a_zone_is_a_rectangle() -> None:
    zone = Rectangle.of_zone(Zone(0.4, 0.1, 0.2, 0.04))
    assert (zone.x, zone.y, zone.yaw_rad, zone.half_x, zone.half_y) == (0.4, 0.1, 0.0, 0.1, 0.02)
