"""Objects and textures of the catalogue, packs by name, and what each level draws from."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from openvima.catalog.geometry import CollisionHull
from openvima.catalog.objects import OBJECTS, object_spec
from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import (
    LEVEL_TITLES,
    OBJECT_SETS,
    PUBLISHED_LEVELS,
    TEXTURE_SETS,
    levels_of,
    pool,
    tasks_at,
)
from openvima.catalog.procedural import ProceduralAssets, procedural_assets
from openvima.catalog.textures import TEXTURES, texture_spec
from openvima.errors import AssetError, ConfigError, UnknownNameError, UnknownTaskError


def test_there_are_31_objects_with_distinct_names():
    assert len(OBJECTS) == 31
    assert all(name == spec.name for name, spec in OBJECTS.items())


def test_objects_equal_the_machine_readable_catalogue(catalogue):
    assert [spec.name for spec in OBJECTS.values()] == [record["name"] for record in catalogue["objects"]]
    for record in catalogue["objects"]:
        spec = OBJECTS[record["name"]]
        assert spec.kind == record["kind"]
        assert spec.profile == record["profile"]
        assert list(spec.aliases) == record["aliases"]
        assert spec.kit_scale == record.get("kit_s")
        assert (spec.symmetry_rad is None) == (record["symmetry_rad"] is None)
        if spec.symmetry_rad is not None:
            assert spec.symmetry_rad == pytest.approx(record["symmetry_rad"], abs=1e-8)
        for ours, theirs in (
            (spec.size_min, "size_min"),
            (spec.size_max, "size_max"),
            (spec.mass_kg, "mass"),
            (spec.friction, "lateral_friction"),
            (spec.com_offset, "com_offset"),
        ):
            value = list(ours) if isinstance(ours, tuple) else ours
            assert value == record[theirs], (spec.name, theirs)


def test_there_are_49_light_textures_and_33_dark_ones_of_one_light_one_each():
    dark = {spec.name for spec in TEXTURES.values() if spec.is_dark}
    assert (len(TEXTURES) - len(dark), len(dark)) == (49, 33)
    assert {spec.dark_variant for spec in TEXTURES.values() if spec.dark_variant} == dark
    for name in dark:
        assert TEXTURES[TEXTURES[name].light_variant].dark_variant == name


def test_dark_colours_are_rounded_down():
    assert texture_spec("dark blue").texel == (42, 65, 90)
    assert texture_spec("dark pink").texel == (178, 109, 116)


def test_unknown_names_are_refused_with_the_nearest_one():
    with pytest.raises(UnknownNameError, match="Did you mean 'letter A'"):
        object_spec("leter A")
    with pytest.raises(UnknownNameError, match="Did you mean 'red swirl'"):
        texture_spec("red swril")


def test_textures_equal_the_machine_readable_catalogue(catalogue):
    assert list(TEXTURES) == [record["name"] for record in catalogue["textures"]]
    for record in catalogue["textures"]:
        spec = TEXTURES[record["name"]]
        assert (spec.is_dark, spec.category) == (record["dark"], record["category"])
        assert spec.dark_variant == record.get("dark_variant")
        assert list(spec.base_colours) == record.get("base_colors", [])
        assert (spec.colour is None) == (record["kind"] == "image")
        if spec.colour is not None:
            assert spec.colour == pytest.approx(record["rgb"], abs=1e-8)


DIGESTS = Path(__file__).parents[1] / "golden" / "procedural_textures.json"
MEAN_TOLERANCE = 15  # levels of 255, per channel


@pytest.fixture(scope="module")
def images():
    return {name: procedural_assets().texture(name) for name in TEXTURES}


def digests(images):
    return {name: hashlib.sha256(image.tobytes()).hexdigest()[:16] for name, image in images.items()}


@pytest.mark.slow
def test_all_textures_are_images_of_bytes(images):
    for name, image in images.items():
        assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3, name
        assert image.flags.c_contiguous
        assert (image.shape == (1, 1, 3)) == (texture_spec(name).colour is not None)


def test_no_two_textures_look_the_same(images):
    assert len(set(digests(images).values())) == len(TEXTURES)


def test_textures_are_the_same_bits_as_when_they_were_recorded(images):
    # After a deliberate change call `record`.
    assert digests(images) == json.loads(DIGESTS.read_text())


def record():
    current = digests({name: procedural_assets().texture(name) for name in TEXTURES})
    DIGESTS.write_text(json.dumps(current, indent=1) + "\n")


def test_mean_colours_are_near_those_of_the_benchmark(images, catalogue):
    for record in catalogue["textures"]:
        if record["kind"] == "image":
            mean = images[record["name"]].reshape(-1, 3).mean(axis=0)
            assert np.abs(mean - record["mean_rgb"]).max() < MEAN_TOLERANCE, record["name"]


SIZE = (0.16, 0.16, 0.05)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENVIMA_CACHE", str(tmp_path / "cache"))


def test_what_is_no_pack_is_refused(tmp_path):
    for value in (None, 3, ["procedural"]):
        with pytest.raises(AssetError, match=r"assets is a \w+; give a name, a folder, or an object with"):
            load_assets(value)
    with pytest.raises(AssetError, match=r"Did you mean 'procedural'\?.*checkout of the original benchmark"):
        load_assets("proceduril")
    with pytest.raises(AssetError, match="no original asset pack"):
        load_assets(tmp_path)


def test_equal_arguments_give_the_same_arrays():
    assert load_assets("procedural") is load_assets()
    assert load_assets().name == "procedural"
    pack = ProceduralAssets()
    assert pack.geometry("hexagon", (0.13, 0.14, 0.035)) is pack.geometry("hexagon", (0.14, 0.13, 0.035))
    assert pack.geometry("container", SIZE) is pack.geometry("container", SIZE)
    assert pack.geometry("container", SIZE) is not pack.geometry("container", (0.15, 0.16, 0.05))
    assert pack.texture("tiger") is pack.texture("tiger")


def test_shared_arrays_cannot_be_written_to():
    pack = ProceduralAssets()
    ring, texture = pack.geometry("ring", SIZE), pack.texture("blue")
    hull = ring.collision[0]
    assert isinstance(hull, CollisionHull)
    for array in (ring.visual.vertices, ring.visual.normals, ring.visual.uvs, hull.points, texture):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0


def test_levels_hold_13_13_13_12_and_4_tasks_and_clutter_the_trained_ones():
    assert [len(tasks_at(level)) for level in PUBLISHED_LEVELS] == [13, 13, 13, 12, 4]
    assert tasks_at("L5") == tasks_at("train")
    assert all(pool(task, "L5") == pool(task, "L3") for task in tasks_at("L3"))
    assert len({task for level in PUBLISHED_LEVELS for task in tasks_at(level)}) == 17


def test_sets_hold_known_names_once():
    for names in OBJECT_SETS.values():
        assert len(set(names)) == len(names) and set(names) <= set(OBJECTS)
    for names in TEXTURE_SETS.values():
        assert len(set(names)) == len(names) and set(names) <= set(TEXTURES)


def test_objects_of_the_third_level_were_never_trained_with_except_the_shorter_block():
    train = {name for task in tasks_at("train") for name in pool(task, "train").dragged_objects}
    novel = {name for task in tasks_at("L3") for name in pool(task, "L3").dragged_objects}
    assert train & novel == {"shorter block"}
    train_bases = {name for task in tasks_at("train") for name in pool(task, "train").base_objects}
    assert train_bases.isdisjoint(OBJECT_SETS["B_novel"])


def test_the_second_level_exchanges_the_textures_of_the_roles():
    assert set(TEXTURE_SETS["C1"]).isdisjoint(TEXTURE_SETS["C2"])
    train, swapped = pool("visual_manipulation", "train"), pool("visual_manipulation", "L2")
    assert swapped.dragged_textures == train.base_textures
    assert swapped.base_textures == train.dragged_textures
    assert swapped.dragged_objects == train.dragged_objects


def test_unknown_tasks_and_levels_are_refused():
    with pytest.raises(
        ConfigError, match=r"sweep_without_exceeding is not defined at level L3; .* train, L1, L2"
    ):
        pool("sweep_without_exceeding", "L3")
    assert levels_of("same_texture") == ("L4",)
    with pytest.raises(UnknownTaskError, match="Did you mean 'rotate'"):
        pool("rotat", "train")
    with pytest.raises(ConfigError, match="Allowed: train, L1, L2, L3, L4"):
        tasks_at("L9")


def test_sets_and_levels_equal_the_machine_readable_catalogue(catalogue):
    assert catalogue["levels"] == LEVEL_TITLES
    for name, members in catalogue["object_sets"].items():
        assert list(OBJECT_SETS[name]) == members, name
    for name, members in catalogue["texture_sets"].items():
        assert list(TEXTURE_SETS[name]) == members, name


@pytest.mark.parametrize("level", PUBLISHED_LEVELS)
def test_pools_equal_the_machine_readable_catalogue(catalogue, level):
    assert list(tasks_at(level)) == list(catalogue["partitions"][level])
    for task, record in catalogue["partitions"][level].items():
        ours = pool(task, level)
        for field, sets in (
            ("dragged_objects", OBJECT_SETS),
            ("base_objects", OBJECT_SETS),
            ("dragged_textures", TEXTURE_SETS),
            ("base_textures", TEXTURE_SETS),
        ):
            members = record.get(field, [])
            expected = sets[members] if isinstance(members, str) else tuple(members)
            assert getattr(ours, field) == expected, (task, field)
