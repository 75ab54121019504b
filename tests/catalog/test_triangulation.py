"""Cutting outlines into triangles: everything is covered once, whatever the shape."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openvima.catalog.meshes import signed_area, triangulate
from openvima.errors import ShapeError

SQUARE = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)])


def areas(loops, triangles):
    points = np.concatenate(loops)
    return [signed_area(points[triangle]) for triangle in triangles]


def test_a_square_becomes_two_triangles():
    assert len(triangulate([SQUARE])) == 2


def test_triangles_of_an_outline_with_two_holes_cover_the_rest():
    holes = [SQUARE[::-1] / 8 + offset for offset in (1.0, 2.5)]
    covered = areas([SQUARE, *holes], triangulate([SQUARE, *holes]))
    assert min(covered) > 0
    assert sum(covered) == pytest.approx(16 - 2 * 0.25)


@given(st.lists(st.floats(0.2, 3.0), min_size=3, max_size=24))
def test_triangles_of_any_star_shaped_outline_cover_it(radii):
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    loop = np.array(radii)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    covered = areas([loop], triangulate([loop]))
    assert len(covered) == len(radii) - 2
    assert min(covered) >= 0
    assert sum(covered) == pytest.approx(signed_area(loop))


def test_a_loop_that_runs_the_wrong_way_round_is_refused():
    with pytest.raises(ShapeError, match="the first must be positive"):
        triangulate([SQUARE[::-1]])


def test_a_hole_outside_its_outline_is_refused():
    surrounding = np.array([(-1.0, -1.0), (-1.0, 5.0), (5.0, 5.0), (5.0, -1.0)])
    with pytest.raises(ShapeError):
        triangulate([SQUARE, surrounding])
