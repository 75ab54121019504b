"""Cameras, the layout of images, and rays."""

import numpy as np
import pytest

from openvima.catalog import load_assets
from openvima.errors import ShapeError
from openvima.render import CAMERAS, FRONT, TOP, VIEWS, channels_first, channels_last, project, unproject
from openvima.render.labels import cell_centres, label_raster
from openvima.render.raycast import Hit, first_hit, object_below
from openvima.tasks import sample_episode

# Point; X and Y (upwards) in the top view; the same in the front view. From the benchmark's own matrices.
KNOWN_POINTS = [
    ((0.5, 0.0, 0.0), (128.0, 64.0), (128.0, 48.0001)),
    ((0.25, -0.5, 0.0), (2.51, 126.745), (2.3024, 92.4429)),
    ((0.75, 0.5, 0.0), (253.49, 1.255), (253.7290, 3.5462)),
    ((0.5, 0.0, 0.1), (128.0, 64.0), (128.0, 65.7788)),
    ((0.41, 0.0, 0.0), (128.0, 86.5882), (128.0, 64.0008)),
]


@pytest.mark.parametrize(("point", "top", "front"), KNOWN_POINTS)
def test_points_land_on_the_pixels_that_the_benchmark_shows_them_at(point, top, front) -> None:
    for camera, (x, y) in ((TOP, top), (FRONT, front)):
        np.testing.assert_allclose(project(np.array(point), camera), (x, 127 - y), atol=1e-4)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("factor", [1, 3])
def test_unproject_undoes_project(view, factor) -> None:
    camera = CAMERAS[view].enlarged(factor)
    rng = np.random.default_rng(1)
    points = rng.uniform((0.2, -0.6, -0.01), (0.8, 0.6, 0.35), (50, 3))
    found = unproject(project(points, camera), camera, z=points[:, 2])
    np.testing.assert_allclose(found, points[:, :2], atol=1e-9)


def test_a_point_behind_the_camera_is_refused_by_name() -> None:
    with pytest.raises(ShapeError, match=r"\(0\.5, 0\.0, 1001\.0\)"):
        project(np.array([[0.5, 0.0, 0.0], [0.5, 0.0, 1001.0]]), TOP)


@pytest.mark.parametrize("leading", [(), (5,), (2, 5)])
def test_the_layouts_differ_in_the_place_of_the_channels_alone(leading) -> None:
    images = np.arange(np.prod(leading, dtype=int) * 24).reshape(*leading, 3, 2, 4)
    last = channels_last(images)
    assert last.shape == (*leading, 2, 4, 3)
    assert np.array_equal(last[..., 1, 3, 2], images[..., 2, 1, 3])
    assert np.array_equal(channels_first(last), images)
    assert np.shares_memory(last, images)


ASSETS = load_assets("procedural")


def test_rays_from_above_meet_the_topmost_object() -> None:
    scene = sample_episode("manipulate_old_neighbor", seed=1).problem.scene
    labels = label_raster(scene, ASSETS)
    rng = np.random.default_rng(0)
    cells = [*rng.permutation(np.argwhere(labels > 0))[:20].tolist(), [160, 2]]
    for row, column in cells:
        around = labels[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
        if (around == labels[row, column]).all():  # not at an outline
            x, y = cell_centres(np.array(row), np.array(column)).tolist()
            assert object_below(scene, (x, y), ASSETS) == labels[row, column]


def test_a_ray_meets_the_table_beside_objects_and_nothing_above_the_horizon() -> None:
    scene = sample_episode("rotate", seed=0).problem.scene
    assert first_hit((), (0.0, 0.0, 1.0), (1.0, 0.5, -2.0), ASSETS) == Hit(0, (0.5, 0.25, 0.0))
    assert first_hit(scene, (0.5, 0.0, 1.0), (0.0, 0.0, 1.0), ASSETS) is None
    assert first_hit(scene, (0.5, 0.0, 1.0), (1.0, 0.0, 0.0), ASSETS) is None


def test_a_slanted_ray_meets_the_near_side() -> None:
    block = next(p for p in sample_episode("rotate", seed=0).problem.scene.placements)
    x, y, z = block.pose.position
    hit = first_hit((block,), (x + 1.0, y, z + 1.0), (-1.0, 0.0, -1.0), ASSETS)
    assert hit is not None and hit.object_id == block.id
    assert hit.point[2] > 0 and hit.point[0] - x == pytest.approx(hit.point[2] - z)
