"""Choosing an asset pack, what it remembers, and the cache on disk."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from openvima.catalog.geometry import CollisionHull
from openvima.catalog.packs import load_assets
from openvima.catalog.procedural import _DRAWING_MODULES, ProceduralAssets, cached_array
from openvima.errors import AssetError, UnknownTextureError
from openvima.input_files import cache_dir

SIZE = (0.16, 0.16, 0.05)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENVIMA_CACHE", str(tmp_path / "cache"))


def test_the_procedural_pack_is_loaded_once():
    assert load_assets("procedural") is load_assets()
    assert load_assets().name == "procedural"


def test_a_pack_is_returned_as_it_is():
    pack = ProceduralAssets()
    assert load_assets(pack) is pack


@pytest.mark.parametrize("value", [None, 3, ["procedural"]])
def test_what_is_no_pack_is_refused(value):
    with pytest.raises(
        AssetError, match=r"assets is a \w+; give a name, a folder, or an object with the methods"
    ):
        load_assets(value)


def test_an_unknown_pack_is_refused_with_what_is_allowed():
    with pytest.raises(AssetError, match=r"Did you mean 'procedural'\?.*checkout of the original benchmark"):
        load_assets("proceduril")


def test_a_folder_without_the_original_pack_is_refused(tmp_path):
    with pytest.raises(AssetError, match="no original asset pack"):
        load_assets(tmp_path)


def test_equal_arguments_give_the_same_arrays():
    pack = ProceduralAssets()
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


def test_objects_of_one_size_share_their_shape():
    pack = ProceduralAssets()
    assert pack.geometry("hexagon", (0.13, 0.14, 0.035)) is pack.geometry("hexagon", (0.14, 0.13, 0.035))


def test_an_unknown_texture_is_refused():
    with pytest.raises(UnknownTextureError, match="Did you mean 'tiger'"):
        ProceduralAssets().texture("tigre")


def test_pictures_are_read_back_from_the_cache_unchanged():
    drawn = ProceduralAssets().texture("magma")
    (file,) = cache_dir().rglob("magma.npy")
    assert np.array_equal(np.load(file), drawn)
    assert np.array_equal(ProceduralAssets().texture("magma"), drawn)


def test_every_module_that_decides_on_a_picture_counts_for_the_cache():
    counted = {module.__name__ for module in _DRAWING_MODULES}
    for module in _DRAWING_MODULES:
        code = Path(str(module.__file__)).read_text(encoding="utf-8")
        assert set(re.findall(r"^from (openvima\.catalog\.\w+) import", code, re.MULTILINE)) <= counted


def test_a_cached_array_is_built_once():
    builds = []

    def build():
        builds.append(1)
        return np.arange(6, dtype=np.uint8)

    first, second = cached_array("group", "key", build), cached_array("group", "key", build)
    assert np.array_equal(first, second) and len(builds) == 1


def test_a_truncated_cache_file_is_replaced():
    path = cache_dir() / "group" / "key.npy"
    cached_array("group", "key", lambda: np.arange(100))
    path.write_bytes(path.read_bytes()[:200])
    assert np.array_equal(cached_array("group", "key", lambda: np.arange(100)), np.arange(100))
    assert len(np.load(path)) == 100


@pytest.mark.parametrize("place", [-1, -20, 200])
def test_a_cache_file_with_a_changed_byte_is_replaced(place, caplog):
    path = cache_dir() / "group" / "key.npy"
    cached_array("group", "key", lambda: np.arange(100))
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    assert np.array_equal(cached_array("group", "key", lambda: np.arange(100)), np.arange(100))
    assert "its checksum is wrong" in caplog.text
    caplog.clear()
    cached_array("group", "key", lambda: np.arange(100))
    assert caplog.text == ""


def test_a_damaged_picture_of_the_procedural_pack_is_drawn_again():
    drawn = ProceduralAssets().texture("tiles")
    (file,) = cache_dir().rglob("tiles.npy")
    content = bytearray(file.read_bytes())
    content[1000] ^= 255
    file.write_bytes(content)
    assert np.array_equal(ProceduralAssets().texture("tiles"), drawn)


def test_a_cache_that_cannot_be_written_is_done_without(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("a file where the folder should be")
    monkeypatch.setenv("OPENVIMA_CACHE", str(blocked))
    assert np.array_equal(cached_array("group", "key", lambda: np.arange(3)), np.arange(3))


def test_the_cache_leaves_no_partial_files():
    cached_array("group", "key", lambda: np.arange(3))
    assert [path.name for path in (cache_dir() / "group").iterdir()] == ["key.npy"]


def test_shapes_and_textures_are_equal_in_another_process():
    code = (
        "import hashlib; from openvima.catalog.procedural import ProceduralAssets as P; p = P();"
        "d = hashlib.sha256(p.texture('granite').tobytes());"
        "d.update(p.geometry('letter G', (0.1, 0.1, 0.1)).visual.vertices.tobytes()); print(d.hexdigest())"
    )
    runs = {
        subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout for _ in "ab"
    }
    assert len(runs) == 1
