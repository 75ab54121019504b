"""Importing the original asset pack: what is taken, what is reported, and what replaces what."""

import hashlib
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from openvima.catalog import OBJECTS, TEXTURES, load_assets, original
from openvima.catalog.original import OriginalAssets, import_pack, imported_folder
from openvima.errors import AssetError
from openvima.video.encoder import png
from task_cases import frozen

REFERENCE = Path(os.environ.get("OPENVIMA_REFERENCE_ASSETS", "../shared/reference_assets"))
SIZE = OBJECTS["cross"].size_max
TRIANGLES = b"""o one
v -10 -10 0
v 10 -10 0
v 0 10 20
v 0 0 20
f 1 2 3
f 1 2 4
f 2 3 4
f 1 3 4
"""


def png_of(value: int) -> bytes:
    return png(Image.new("RGB", (6, 4), (value,) * 3))


FILES = {
    "kitting/cross.obj": TRIANGLES,
    "kitting/heart.obj": TRIANGLES.replace(b"20", b"10"),
    "kitting/object-template.urdf": b"<robot/>\n",
    "textures/granite.png": png_of(100),
    "textures/wood_light.png": png_of(150),
}


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENVIMA_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def checkout(tmp_path, monkeypatch) -> Path:
    """A checkout of five small files, which stand for the original ones."""
    hashes = {path: hashlib.sha256(content).hexdigest() for path, content in FILES.items()}
    monkeypatch.setattr(original, "known_hashes", lambda: hashes)
    for path, content in FILES.items():
        file = tmp_path / "checkout" / original.PACK_FOLDER / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
    return tmp_path / "checkout"


def in_pack(checkout: Path, path: str) -> Path:
    return checkout / original.PACK_FOLDER / path


def test_an_import_holds_every_file_and_needs_the_checkout_no_more(checkout):
    assert import_pack(checkout) == []
    shutil.rmtree(checkout)
    assets = load_assets("original")
    assert assets.name == "original"
    assert assets.texture("granite").tolist() == np.full((4, 6, 3), 100).tolist()
    assert assets.geometry("cross", SIZE).visual.vertices.shape == (4, 3, 3)


def test_missing_and_damaged_files_are_named_and_the_rest_is_imported(checkout):
    in_pack(checkout, "kitting/cross.obj").unlink()
    in_pack(checkout, "textures/granite.png").write_bytes(png_of(100)[:-20])
    missing, damaged = import_pack(checkout)
    assert "kitting/cross.obj is missing" in missing and "textures/granite.png differs" in damaged
    assets = load_assets("original")
    assert assets.texture("wooden").shape == (4, 6, 3)
    command = "`openvima assets import CHECKOUT`"
    with pytest.raises(AssetError, match=rf"object 'cross'.*kitting/cross\.obj.*{command}"):
        assets.geometry("cross", SIZE)
    with pytest.raises(AssetError, match=rf"texture 'granite'.*textures/granite\.png is missing.*{command}"):
        assets.texture("granite")
    for pack in (OriginalAssets(imported_folder()), OriginalAssets(checkout)):
        assert len(pack.problems()) == 2
        with pytest.raises(AssetError, match=r"kitting/cross\.obj is missing"):
            pack.geometry("cross", SIZE)


def test_importing_again_replaces_the_import_and_what_was_loaded_of_it(checkout):
    content = in_pack(checkout, "kitting/cross.obj").read_bytes()
    in_pack(checkout, "kitting/cross.obj").unlink()
    import_pack(checkout)
    with pytest.raises(AssetError, match="cross"):
        load_assets("original").geometry("cross", SIZE)
    in_pack(checkout, "kitting/cross.obj").write_bytes(content)
    import_pack(checkout)
    assert load_assets("original").geometry("cross", SIZE).visual.vertices.shape == (4, 3, 3)


def test_an_import_that_fails_leaves_the_last_one(checkout, tmp_path):
    import_pack(checkout)
    with pytest.raises(AssetError, match="no original asset pack"):
        import_pack(tmp_path)
    for path in FILES:
        in_pack(checkout, path).write_bytes(b"damaged")
    with pytest.raises(AssetError, match="none of the 5 files"):
        import_pack(checkout)
    assert OriginalAssets(imported_folder()).problems() == []


def test_a_changed_byte_of_an_import_is_noticed(checkout):
    import_pack(checkout)
    (imported_folder() / "kitting/heart.obj").write_bytes(FILES["kitting/heart.obj"].replace(b"10", b"11"))
    with pytest.raises(AssetError, match=r"heart.*differs.*`openvima assets import CHECKOUT`"):
        load_assets("original").geometry("heart", SIZE)


needs_reference = pytest.mark.skipif(
    not (REFERENCE / original.PACK_FOLDER).is_dir(),
    reason=f"{REFERENCE} is absent; OPENVIMA_REFERENCE_ASSETS names another folder",
)


@pytest.fixture(scope="module")
def imported_reference(tmp_path_factory) -> Path:
    """A cache with the reference assets imported."""
    cache = tmp_path_factory.mktemp("reference_cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OPENVIMA_CACHE", str(cache))
        assert import_pack(REFERENCE) == []
    return cache


@needs_reference
@pytest.mark.slow
def test_golden_import_equals_the_checkout_bit_for_bit(imported_reference, monkeypatch):
    monkeypatch.setenv("OPENVIMA_CACHE", str(imported_reference))
    ours, theirs = load_assets("original"), OriginalAssets(REFERENCE)
    assert ours is not theirs
    for name in TEXTURES:
        assert np.array_equal(ours.texture(name), theirs.texture(name)), name
    for name, spec in OBJECTS.items():
        a, b = (frozen(pack.geometry(name, spec.size_max)) for pack in (ours, theirs))
        assert a == b, name
