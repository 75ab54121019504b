"""Looks of no catalogue: drawn from seeds, whole, varied, and beside the catalogue's own."""

import json
from pathlib import Path

import numpy as np
import pytest

from openvima.catalog.meshes import signed_area
from openvima.catalog.packs import load_assets
from openvima.catalog.random_pack import (
    RandomAppearanceAssets,
    darken_texture,
    has_visible_heading,
    is_random,
    random_name,
    random_texture,
)
from openvima.catalog.random_shapes import (
    has_heading,
    random_container,
    random_eared_container,
    random_grating,
    random_outline,
    random_round_container,
    random_square_container,
)
from openvima.errors import UnknownNameError
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Placement, Pose, Scene

SIZE = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def looks() -> RandomAppearanceAssets:
    return RandomAppearanceAssets(load_assets("procedural"))


def test_a_name_always_stands_for_the_same_look(looks):
    again = RandomAppearanceAssets(load_assets("procedural"))
    names = [random_name("texture", np.random.default_rng(k)) for k in range(20)]
    assert len(set(names)) == 20
    assert all(np.array_equal(looks.texture(name), again.texture(name)) for name in names)
    shape = looks.geometry("random shape 3", SIZE).visual.vertices
    assert np.array_equal(shape, again.geometry("random shape 3", SIZE).visual.vertices)


def test_random_textures_are_of_many_kinds_and_colours():
    textures = [random_texture(np.random.default_rng(k)) for k in range(60)]
    assert all(texture.dtype == np.uint8 and texture.ndim == 3 for texture in textures)
    assert 3 < sum(texture.shape == (1, 1, 3) for texture in textures) < 30
    assert len({tuple(texture[0, 0].tolist()) for texture in textures}) > 50


def test_dark_random_textures_are_made_as_those_of_the_catalogue(looks):
    blue = looks.texture("blue")
    assert np.abs(darken_texture(blue).astype(int) - looks.texture("dark blue")).max() <= 1
    light, dark = looks.texture("random texture 7"), looks.texture("dark random texture 7")
    assert np.array_equal(dark, darken_texture(light))
    assert (dark <= light).all() and (dark < light).any()


def test_random_outlines_are_whole_and_of_the_size_of_kit_objects(looks):
    for seed in range(150):
        loops = random_outline(np.random.default_rng(seed))
        assert 0.07 - 1e-5 <= np.ptp(loops[0], axis=0).max() <= 0.125 + 1e-5
        mesh = looks.geometry(f"random shape {seed}", SIZE).visual  # cutting it up finds lines that cross
        area = sum(signed_area(loop) for loop in loops)
        top = mesh.vertices[(mesh.normals[:, 0, 2] == 1)]
        triangles = np.cross(top[:, 1] - top[:, 0], top[:, 2] - top[:, 0])[:, 2] / 2
        np.testing.assert_allclose(triangles.sum(), area, rtol=1e-6)


@pytest.mark.parametrize(
    "draw",
    [
        random_container,
        random_grating,
        random_eared_container,
        random_square_container,
        random_round_container,
    ],
)
def test_random_vessels_stand_on_the_table(draw):
    for seed in range(40):
        container = draw(np.random.default_rng(seed))
        assert abs(container.visual.vertices[..., 2].min() + container.rest_z_m) < 0.0025
        assert 0.08 < np.ptp(container.visual.vertices[..., :2].reshape(-1, 2), axis=0).max() < 0.3


def test_the_gaps_of_gratings_are_real_and_ears_make_a_container_longer(looks):
    rasteriser = Rasteriser(looks)

    def fill_of(name: str, yaw_rad: float) -> float:
        """Fraction of the box that an object's pixels fill, seen from above."""
        pose = Pose.planar(0.5, 0.0, yaw_rad, z=looks.geometry(name, SIZE).rest_z_m)
        scene = Scene((Placement(5, name, "red", SIZE, pose),))
        rows, columns = np.nonzero(rasteriser.scene(scene)["top"].segm == 5)
        return len(rows) / (np.ptp(rows) + 1) / (np.ptp(columns) + 1)

    for seed in range(5):
        assert fill_of(f"random grating {seed}", 0.0) < 0.97
    assert np.mean([fill_of(f"random grating {seed}", 0.0) for seed in range(20)]) < 0.85
    for seed in range(5):
        rng = np.random.default_rng(seed)
        plain, eared = random_container(rng), random_eared_container(np.random.default_rng(seed))
        longer = np.ptp(eared.visual.vertices, axis=(0, 1)) - np.ptp(plain.visual.vertices, axis=(0, 1))
        assert longer.min() >= 0.0 and 0.003 < longer[:2].max() < 0.06


def test_stretched_random_shapes_are_as_much_higher(looks):
    flat = looks.geometry("random shape 3", SIZE).visual.vertices
    high = looks.geometry("random shape 3", SIZE, (1.0, 1.0, 2.0)).visual.vertices
    np.testing.assert_allclose(high, flat * (1, 1, 2))


def kit_outline(name):
    """Outer loop and holes of a flat object of the catalogue."""
    loops = json.loads(Path(__file__).with_name("kit_outlines.json").read_text(encoding="utf-8"))[name]
    return tuple(np.array(loop, np.float64) for loop in loops)


def test_shapes_without_symmetry_show_their_heading():
    for name in ("letter A", "letter R", "letter G", "heart", "L-shaped block"):
        assert has_heading(kit_outline(name)) and has_visible_heading(name)
    for name in ("cross", "flower", "hexagon", "ring", "diamond", "star"):
        assert not has_heading(kit_outline(name)) and not has_visible_heading(name)
    assert not has_visible_heading("random container 4")
    assert sum(has_visible_heading(f"random shape {seed}") for seed in range(40)) > 20


def test_random_looks_never_ask_for_outlines_or_textures_of_the_catalogue():
    def refused(*arguments):
        raise AssertionError(f"{arguments} was asked for")

    class Empty:
        name = "empty"
        geometry = texture = refused

    looks = RandomAppearanceAssets(Empty())
    rng = np.random.default_rng(0)
    for kind in ("shape", "container", "grating", "eared container", "texture"):
        for _ in range(20):
            name = random_name(kind, rng)
            assert is_random(name)
            looks.texture(name) if kind == "texture" else looks.geometry(name, SIZE)


def test_names_of_the_catalogue_go_through(looks):
    base = load_assets("procedural")
    assert looks.texture("red swirl") is base.texture("red swirl")
    assert looks.geometry("letter A", SIZE) is base.geometry("letter A", SIZE)
    assert not is_random("red swirl")
    with pytest.raises(UnknownNameError):
        looks.texture("random texture seven")
