"""Packs by name, and what each level draws from."""

import pytest

from openvima.catalog.geometry import CollisionHull
from openvima.catalog.objects import OBJECTS
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
from openvima.catalog.procedural import ProceduralAssets
from openvima.catalog.textures import TEXTURES
from openvima.errors import AssetError, ConfigError, UnknownTaskError

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
