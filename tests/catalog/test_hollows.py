"""What collides: hollows hold things, the pan bears them on its lid, a disk slides over a rod."""

import os
from pathlib import Path

import pytest

from openvima.catalog import OBJECTS, Assets, load_assets
from openvima.scene import Placement, Pose, Scene
from openvima.sim.bodies import Bodies
from openvima.sim.primitive_state import Settling

PACK = Path(os.environ.get("OPENVIMA_REFERENCE_ASSETS", "../shared/reference_assets"))
X, Y = 0.5, 0.05


@pytest.fixture(params=["procedural", "golden original"])
def assets(request) -> Assets:
    if request.param == "procedural":
        return load_assets()
    if not PACK.is_dir():
        pytest.skip(f"{PACK} is absent; OPENVIMA_REFERENCE_ASSETS names another folder")
    return load_assets(PACK)


def dropped(assets: Assets, name: str, onto: str, offset: tuple[float, float], height_m: float) -> Pose:
    """Where an object comes to rest, relative to the fixed one above which it was let go."""
    base_z = assets.geometry(onto, OBJECTS[onto].size_max).rest_z_m
    base = Placement(5, onto, "red", OBJECTS[onto].size_max, Pose.planar(X, Y, 0.0, z=base_z), fixed=True)
    start = Pose.planar(X + offset[0], Y + offset[1], 0.3, z=base_z + height_m)
    bodies = Bodies(Scene((base, Placement(6, name, "blue", OBJECTS[name].size_max, start))), assets)
    settling = Settling(bodies)
    while not settling.is_over:
        settling.run()
    assert settling.is_at_rest
    pose = bodies.pose(1)
    return Pose.planar(pose.x - X, pose.y - Y, 0.0, z=pose.z - base_z)


def middle(assets: Assets, name: str) -> tuple[float, float]:
    """Middle of what a body collides with; the original bowl stands beside its origin."""
    if name != "bowl" or assets.name == "procedural":
        return (0.0, 0.0)
    return (-0.0435, 0.0144)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.035, 0.0), (-0.03, 0.03)])
@pytest.mark.parametrize(("name", "reach_m", "floor_z"), [("bowl", 0.075, 0.0), ("container", 0.09, -0.024)])
def test_a_small_block_dropped_into_a_hollow_stays_in_it(assets, name, reach_m, floor_z, offset) -> None:
    x, y = middle(assets, name)
    pose = dropped(assets, "small block", name, (x + offset[0], y + offset[1]), 0.09)
    assert max(abs(pose.x - x), abs(pose.y - y)) < reach_m
    assert floor_z + 0.013 < pose.z < floor_z + 0.035  # on its floor, or leaning on a wall


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.04, 0.02), (-0.05, 0.0)])
def test_a_small_block_dropped_onto_a_pan_stays_on_its_lid(assets, offset) -> None:
    pose = dropped(assets, "small block", "pan", offset, 0.06)
    assert max(abs(pose.x), abs(pose.y)) < 0.085
    assert 0.025 < pose.z < 0.045


def test_a_block_dropped_onto_a_ring_does_not_fall_through(assets) -> None:
    assert dropped(assets, "small block", "ring", (0.0, 0.0), 0.06).z > 0.04


@pytest.mark.parametrize("rod_y", [-0.18, 0.0, 0.18])
def test_a_disk_dropped_over_a_rod_slides_down_to_the_plate(rod_y) -> None:
    pose = dropped(load_assets(), "disk", "stand", (0.003, rod_y), 0.13)
    assert pose.z == pytest.approx(0.005 + 0.015, abs=0.002)
    assert abs(pose.y - rod_y) < 0.02


def test_a_disk_dropped_between_two_rods_stays_between_them() -> None:
    pose = dropped(load_assets(), "disk", "stand", (0.0, 0.09), 0.06)
    assert pose.z == pytest.approx(0.005 + 0.015, abs=0.002)
