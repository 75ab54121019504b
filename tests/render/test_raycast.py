"""What rays meet, compared with the label raster, which is made of the same meshes in another way."""

import numpy as np
import pytest

from openvima.catalog import load_assets
from openvima.render.labels import cell_centres, label_raster
from openvima.render.raycast import Hit, first_hit, object_below
from openvima.tasks import sample_episode

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
