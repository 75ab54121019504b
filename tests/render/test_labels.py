"""Label images and glTF files."""

import io

import numpy as np
import pytest

from openvima.catalog.packs import load_assets
from openvima.render import CELL_M, LABEL_SHAPE, cell_centres, empty_labels, label_raster, stamp
from openvima.scene import Placement, Pose, Scene
from sim_cases import BoxAssets

ASSETS = BoxAssets()


def boxed(object_id: int, pose: Pose, size: tuple[float, float, float] = (0.1, 0.05, 0.02)) -> Placement:
    return Placement(object_id, "block", "red", size, pose)


def test_cells_whose_centre_lies_on_the_object_carry_its_id() -> None:
    pose = Pose.planar(0.4, 0.2, 0.5, z=0.009)
    labels = label_raster(Scene((boxed(7, pose),)), ASSETS)
    assert labels.shape == LABEL_SHAPE == (320, 160)
    assert labels.dtype == np.int16
    rows, columns = np.indices(LABEL_SHAPE)
    centres = cell_centres(rows, columns)
    local = pose.inverse().transform(np.dstack([centres, np.full(LABEL_SHAPE, 0.009)]))
    inside = (np.abs(local[..., 0]) <= 0.05) & (np.abs(local[..., 1]) <= 0.025)
    np.testing.assert_array_equal(labels == 7, inside)
    assert abs(inside.sum() * CELL_M**2 - 0.1 * 0.05) < 1e-4


def test_centres_of_the_corner_cells_lie_half_a_cell_inside_the_table() -> None:
    first, last = cell_centres(np.array([0, 319]), np.array([0, 159]))
    np.testing.assert_allclose(first, (0.25 + CELL_M / 2, -0.5 + CELL_M / 2))
    np.testing.assert_allclose(last, (0.75 - CELL_M / 2, 0.5 - CELL_M / 2))


def test_the_higher_surface_counts_in_either_order() -> None:
    low = boxed(5, Pose.planar(0.5, 0.0, z=0.01))
    high = boxed(6, Pose.planar(0.5, 0.0, z=0.03), (0.03, 0.03, 0.02))
    one, other = label_raster((low, high), ASSETS), label_raster((high, low), ASSETS)
    np.testing.assert_array_equal(one, other)
    assert one[160, 80] == 6
    assert set(np.unique(one)) == {0, 5, 6}


def test_stamping_one_by_one_gives_the_raster_of_all() -> None:
    rng = np.random.default_rng(3)
    drawn = rng.uniform((0.25, -0.5, 0.0), (0.75, 0.5, 6.0), (6, 3))
    placements = [boxed(5 + i, Pose.planar(*xy_yaw, z=0.01 * i)) for i, xy_yaw in enumerate(drawn)]
    labels, heights = empty_labels()
    for placement in placements:
        stamp(labels, heights, placement, ASSETS)
    np.testing.assert_array_equal(labels, label_raster(placements, ASSETS))
    np.testing.assert_array_equal(heights > 0, labels > 0)


def test_tilted_bodies_show_what_faces_up() -> None:
    half_turn_about_x = Pose((0.5, 0.0, 0.05), (1.0, 0.0, 0.0, 0.0))
    labels = label_raster([boxed(5, half_turn_about_x)], ASSETS)
    assert (labels == 5).sum() == (label_raster([boxed(5, Pose.planar(0.5, 0.0, z=0.05))], ASSETS) == 5).sum()


def test_what_is_above_the_ceiling_or_below_the_sheet_or_off_the_table_does_not_count() -> None:
    placements = [
        boxed(5, Pose.planar(0.4, 0.0, z=0.295)),
        boxed(6, Pose.planar(0.6, 0.0, z=-0.02)),
        boxed(7, Pose.planar(1.2, 0.0, z=0.01)),
    ]
    assert not label_raster(placements, ASSETS).any()


def test_an_object_keeps_vertices_normals_and_texture() -> None:
    trimesh = pytest.importorskip("trimesh")
    from openvima.render.gltf import object_glb

    assets, size, scale = load_assets(), (0.05, 0.05, 0.05), (1.0, 1.0, 1.0)
    read = trimesh.load(io.BytesIO(object_glb(assets, "block", "red swirl", size, scale)), file_type="glb")
    (mesh,) = read.geometry.values()
    drawn = assets.geometry("block", size, scale).visual
    assert np.allclose(mesh.triangles, drawn.vertices)
    assert np.allclose(mesh.vertex_normals[mesh.faces], drawn.normals, atol=1e-6)
    assert np.array_equal(np.asarray(mesh.visual.material.baseColorTexture), assets.texture("red swirl"))
