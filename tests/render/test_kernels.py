"""Kernels: compared with their naive twins, and on triangles where each rule decides."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import naive
from openvima.catalog import TriangleMesh
from openvima.catalog.bodies import block
from openvima.render import FRONT, TOP
from openvima.render.camera import Camera
from openvima.render.kernels import (
    draw_triangles,
    index_mesh,
    light_intensity,
    matrix_3x4,
    stamp_triangles,
    texel_index,
)
from openvima.render.labels import CEILING_M, empty_labels
from openvima.scene import Pose
from sim_cases import random_mesh, triangle

SMALL = {
    camera.view: replace(camera, width=32, height=16, focal_px=camera.focal_px / 8) for camera in (FRONT, TOP)
}
# A camera for which one pixel is one unit at z = 0: X = 4 + x, Y = 4 + y, exactly.
UNIT = Camera("top", 8, 8, 1000.0, (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 1000.0))
WHITE = np.full((1, 1, 3), 255, dtype=np.uint8)
Body = tuple[TriangleMesh, Pose, int, np.ndarray]


def draw(bodies: list[Body], camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    shape = (camera.height, camera.width)
    rgb, segm = np.full((3, *shape), 255, dtype=np.uint8), np.full(shape, 255, dtype=np.uint8)
    depth = np.full(shape, np.inf)
    for body, pose, object_id, texture in bodies:
        mesh = index_mesh(body)
        draw_triangles(
            mesh.vertices,
            mesh.corners,
            mesh.normals,
            mesh.uvs,
            mesh.is_flat,
            matrix_3x4(pose),
            texture,
            object_id,
            camera.matrix(),
            rgb,
            segm,
            depth,
        )
    return rgb, segm


def covered(mesh: TriangleMesh, camera: Camera = UNIT) -> set[tuple[int, int]]:
    """X and Y (upwards) of the sampling points that show the mesh, about the middle of the image."""
    _, segm = draw([(mesh, Pose((0.0, 0.0, 0.0)), 5, WHITE)], camera)
    rows, columns = np.nonzero(segm == 5)
    return {
        (int(c) - camera.width // 2, camera.height // 2 - 1 - int(r))
        for r, c in zip(rows, columns, strict=True)
    }


def stamped(bodies: list[tuple[TriangleMesh, Pose, int]]) -> tuple[np.ndarray, np.ndarray]:
    labels, heights = empty_labels()
    for body, pose, object_id in bodies:
        mesh = index_mesh(body)
        half, cell = 0.0015625, 0.003125
        stamp_triangles(
            mesh.vertices,
            mesh.corners,
            matrix_3x4(pose),
            object_id,
            0.25 + half,
            -0.5 + half,
            cell,
            CEILING_M,
            labels,
            heights,
        )
    return labels, heights


def random_bodies(seed: int) -> list[Body]:
    rng = np.random.default_rng(seed)
    bodies: list[Body] = []
    for object_id in (5, 6):
        quaternion = rng.normal(size=4)
        qx, qy, qz, qw = (float(q) for q in quaternion / np.linalg.norm(quaternion))
        x, y, z = rng.uniform((0.3, -0.4, 0.0), (0.7, 0.4, 0.1))
        texture = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
        mesh = random_mesh(rng, 12, 0.2)
        bodies.append((mesh, Pose((float(x), float(y), float(z)), (qx, qy, qz, qw)), object_id, texture))
    return bodies


@pytest.mark.parametrize("view", ["front", "top"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_triangles_are_drawn_as_by_the_naive_twin(view, seed) -> None:
    bodies = random_bodies(seed)
    rgb, segm = draw(bodies, SMALL[view])
    naive_rgb, naive_segm = naive.draw(bodies, SMALL[view])
    assert (naive_segm != 255).sum() > 50
    np.testing.assert_array_equal(segm, naive_segm)
    # Rounding just below or above a whole number moves a truncated colour by one level.
    assert np.abs(rgb.astype(int) - naive_rgb).max() <= 1


def test_a_mesh_with_shared_corners_is_drawn_as_one_without() -> None:
    rng = np.random.default_rng(4)
    many = random_mesh(rng, 300, 0.1)  # below the number from which equal corners are merged
    twice = TriangleMesh(*(np.tile(a, (2, 1, 1)) for a in (many.vertices, many.normals, many.uvs)))
    assert len(index_mesh(twice).vertices) < 2 * len(index_mesh(many).vertices)
    pose = Pose.planar(0.5, 0.0, 0.3)
    for one, other in zip(
        draw([(many, pose, 5, WHITE)], SMALL["top"]),
        draw([(twice, pose, 5, WHITE)], SMALL["top"]),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


def test_sampling_points_on_edges_and_corners_belong_to_a_triangle() -> None:
    mesh = triangle((0, 0, 0), (3, 0, 0), (0, 3, 0))
    assert covered(mesh) == {(x, y) for x in range(4) for y in range(4) if x + y <= 3}


def test_triangles_that_cross_the_border_are_cut_there() -> None:
    assert covered(triangle((-50, -50, 0), (50, -50, 0), (0, 50, 0))) == {
        (x, y) for x in range(-4, 4) for y in range(-4, 4)
    }
    assert covered(triangle((2, 2, 0), (9, 2, 0), (2, 9, 0))) == {(2, 2), (3, 2), (2, 3), (3, 3)}


@pytest.mark.parametrize(
    "corners",
    [
        ((0, 0, 0), (0, 3, 0), (3, 0, 0)),  # shows its back
        ((0, 0, 0), (2, 2, 0), (3, 3, 0)),  # a line
        ((1, 1, 0), (1, 1, 0), (1, 1, 0)),  # a point
        ((0, 0, 0), (3, 0, 0), (0, 0.0033, 0)),  # next to no area
        ((0.2, 0.2, 0), (0.8, 0.2, 0), (0.2, 0.8, 0)),  # between sampling points
        ((5, 5, 0), (9, 5, 0), (5, 9, 0)),  # beside the image
        ((0, 0, 1001), (3, 0, 1001), (0, 3, 1001)),  # behind the camera
        ((float("nan"), 0, 0), (3, 0, 0), (0, 3, 0)),
    ],
)
def test_degenerate_or_invisible_triangles_leave_no_trace(corners) -> None:
    assert covered(triangle(*corners)) == set()
    # One above the smallest area is drawn.
    assert covered(triangle((0, 0, 0), (3, 0, 0), (0, 0.0034, 0))) == {(0, 0), (1, 0), (2, 0), (3, 0)}


def test_of_equal_depths_the_later_body_shows() -> None:
    square = triangle((-3, -3, 0.5), (3, -3, 0.5), (-3, 3, 0.5))
    nearer = triangle((-3, -3, 0.6), (0, -3, 0.6), (-3, 0, 0.6))
    here = Pose((0.0, 0.0, 0.0))
    _, segm = draw([(square, here, 5, WHITE), (square, here, 6, WHITE)], UNIT)
    assert set(np.unique(segm)) == {6, 255}
    _, segm = draw([(nearer, here, 5, WHITE), (square, here, 6, WHITE)], UNIT)
    assert set(np.unique(segm)) == {5, 6, 255}


def test_boxes_that_overlap_at_equal_heights_show_the_later_one() -> None:
    # Differently turned, so that equal heights are interpolated from different corners.
    box = block((0.03, 0.03, 0.03)).visual
    bodies = [
        (box, Pose.planar(0.5, 0.0, 0.3, z=0.014), 5, WHITE),
        (box, Pose.planar(0.505, 0.004, 1.1, z=0.014), 6, WHITE),
    ]
    for camera in (TOP, FRONT):
        both = np.all([draw([body], camera)[0][0] == 239 for body in bodies], axis=0)  # faces that show up
        assert both.any()
        assert (draw(bodies, camera)[1][both] == 6).all()


def test_faces_along_the_axes_have_the_benchmarks_brightness_and_all_that_of_the_naive_twin() -> None:
    known = {(0, 0, 1): 0.93967, (0, 0, -1): 0.63731, (-1, 0, 0): 0.75118, (0, 1, 0): 0.69071}
    for normal, expected in known.items():
        assert light_intensity(*map(float, normal)) == pytest.approx(expected, abs=5e-6)
    others = np.random.default_rng(5).normal(size=(200, 3))
    for normal in (*np.eye(3), *-np.eye(3), *others / np.linalg.norm(others, axis=1, keepdims=True)):
        assert light_intensity(*normal) == pytest.approx(naive.light_intensity(normal), abs=1e-12)


@pytest.mark.parametrize(
    ("u", "v", "row", "column"),
    [
        (0.0, 0.0, 3, 0),
        (0.99, 0.99, 0, 4),
        (1.0, 1.0, 3, 0),  # wraps
        (0.2, 0.25, 2, 1),
        (-1e-20, -1e-20, 0, 4),  # a rounding error below 0, at the far border
    ],
)
def test_texture_coordinates_find_the_nearest_texel(u, v, row, column) -> None:
    assert texel_index(u, v, 4, 5) == (row, column)


def test_labels_are_those_of_the_naive_twin() -> None:
    rng = np.random.default_rng(6)
    box = block((0.04, 0.03, 0.02)).visual
    bodies = [
        (box, Pose.planar(0.30, -0.45, 0.4, z=0.01), 5),
        (box, Pose.planar(0.31, -0.44, 1.3, z=0.01), 6),  # overlaps at equal height
        (random_mesh(rng, 20, 0.04), Pose.planar(0.35, -0.43, 2.0, z=0.29), 7),  # reaches over the ceiling
        (box, Pose.planar(0.25, -0.40, 0.1, z=0.03), 8),  # half beside the table
        (box, Pose.planar(0.38, -0.47, 0.2, z=-0.02), 9),  # below the sheet
    ]
    labels, heights = stamped(bodies)
    rows, columns = range(0, 48), range(0, 56)
    naive_labels, naive_heights = naive.label_cells(bodies, rows, columns)
    np.testing.assert_array_equal(labels[:48, :56], naive_labels)
    np.testing.assert_allclose(heights[:48, :56], naive_heights, atol=1e-6)
    assert set(np.unique(naive_labels)) == {0, 5, 6, 7, 8}
    assert not labels[48:].any()


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="is this very run")
@pytest.mark.slow
def test_the_kernels_stay_within_their_arrays() -> None:
    """Run this file uncompiled, where an index past the end raises."""
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
