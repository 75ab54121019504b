"""Choosing an asset pack, what it remembers, and the cache on disk."""

import subprocess
import sys

import pytest

from openvima.catalog.geometry import CollisionHull
from openvima.catalog.packs import load_assets
from openvima.catalog.procedural import ProceduralAssets
from openvima.errors import AssetError

SIZE = (0.16, 0.16, 0.05)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENVIMA_CACHE", str(tmp_path / "cache"))


def test_the_procedural_pack_is_loaded_once():
    assert load_assets("procedural") is load_assets()
    assert load_assets().name == "procedural"


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
