"""Importing the original asset pack: what is taken, what is reported, and what replaces what."""

import hashlib
import io
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from openvima.catalog import OBJECTS, TEXTURES, CollisionHull, load_assets, original
from openvima.catalog.original import OriginalAssets, import_pack, imported_pack
from openvima.errors import AssetError
from openvima.input_files import cache_dir

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


def png(value: int) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.full((4, 6, 3), value, np.uint8)).save(stream, "PNG")
    return stream.getvalue()


FILES = {
    "kitting/cross.obj": TRIANGLES,
    "kitting/heart.obj": TRIANGLES.replace(b"20", b"10"),
    "kitting/object-template.urdf": b"<robot/>\n",
    "textures/granite.png": png(100),
    "textures/wood_light.png": png(150),
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
    pack = import_pack(checkout)
    assert pack.is_complete and set(pack.files) == set(FILES)
    shutil.rmtree(checkout)
    assets = load_assets("original")
    assert assets.name == "original"
    assert assets.texture("granite").tolist() == np.full((4, 6, 3), 100).tolist()
    assert assets.geometry("cross", SIZE).visual.vertices.shape == (4, 3, 3)
    assert imported_pack() == pack


def test_an_import_equals_its_checkout(checkout):
    import_pack(checkout)
    ours, theirs = load_assets("original"), load_assets(checkout)
    assert ours is not theirs
    assert ours.geometry("heart", SIZE).visual.vertices.tobytes() == (
        theirs.geometry("heart", SIZE).visual.vertices.tobytes()
    )


def test_missing_and_damaged_files_are_named_and_the_rest_is_imported(checkout):
    in_pack(checkout, "kitting/cross.obj").unlink()
    in_pack(checkout, "textures/granite.png").write_bytes(png(100)[:-20])
    pack = import_pack(checkout)
    assert len(pack.problems) == 2 and not pack.is_complete
    assert any("kitting/cross.obj is missing" in problem for problem in pack.problems)
    assert any("textures/granite.png differs" in problem for problem in pack.problems)
    assets = load_assets("original")
    assert assets.texture("wooden").shape == (4, 6, 3)
    command = r"`openvima assets import CHECKOUT` again"
    with pytest.raises(AssetError, match=rf"object 'cross'.*kitting/cross\.obj.*{command}"):
        assets.geometry("cross", SIZE)
    with pytest.raises(AssetError, match=rf"texture 'granite'.*textures/granite\.png.*{command}"):
        assets.texture("granite")
    restored = imported_pack()
    assert restored is not None and restored.problems == pack.problems


def test_importing_again_replaces_the_import_and_what_was_loaded_of_it(checkout):
    content = in_pack(checkout, "kitting/cross.obj").read_bytes()
    in_pack(checkout, "kitting/cross.obj").unlink()
    import_pack(checkout)
    with pytest.raises(AssetError, match="cross"):
        load_assets("original").geometry("cross", SIZE)
    in_pack(checkout, "kitting/cross.obj").write_bytes(content)
    import_pack(checkout)
    assert load_assets("original").geometry("cross", SIZE).visual.vertices.shape == (4, 3, 3)
    assert [path.name for path in cache_dir().iterdir() if path.is_file()] == [original.ARCHIVE_NAME]


def test_an_import_that_fails_leaves_the_last_one(checkout, tmp_path, monkeypatch):
    import_pack(checkout)
    with pytest.raises(AssetError, match="no original asset pack"):
        import_pack(tmp_path)
    for path in FILES:
        in_pack(checkout, path).write_bytes(b"damaged")
    with pytest.raises(AssetError, match="none of the 5 files"):
        import_pack(checkout)
    in_pack(checkout, "kitting/cross.obj").write_bytes(FILES["kitting/cross.obj"])

    def full_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("zipfile.ZipFile.writestr", full_disk)
    with pytest.raises(OSError, match="No space"):
        import_pack(checkout)
    pack = imported_pack()
    assert pack is not None and pack.is_complete
    assert [path.name for path in cache_dir().iterdir() if path.is_file()] == [original.ARCHIVE_NAME]


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.999])
def test_a_truncated_archive_asks_for_another_import(checkout, keep):
    archive = import_pack(checkout).archive
    content = archive.read_bytes()
    archive.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(AssetError, match=r"damaged.*import"):
        imported_pack()
    with pytest.raises(AssetError, match=r"heart.*`openvima assets import CHECKOUT` again"):
        load_assets("original").geometry("heart", SIZE)


def test_a_changed_byte_in_the_archive_is_noticed(checkout):
    archive = import_pack(checkout).archive
    content = archive.read_bytes()
    place = content.index(FILES["kitting/heart.obj"]) + 10
    archive.write_bytes(content[:place] + b"7" + content[place + 1 :])
    with pytest.raises(AssetError, match=r"heart.*`openvima assets import CHECKOUT` again"):
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
        assert import_pack(REFERENCE).is_complete
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
        a, b = ours.geometry(name, spec.size_max), theirs.geometry(name, spec.size_max)
        assert a.visual.vertices.tobytes() == b.visual.vertices.tobytes(), name
        assert a.visual.normals.tobytes() == b.visual.normals.tobytes(), name
        assert a.visual.uvs.tobytes() == b.visual.uvs.tobytes(), name
        assert a.rest_z_m == b.rest_z_m and len(a.collision) == len(b.collision)
        for mine, other in zip(a.collision, b.collision, strict=True):
            same = (
                np.array_equal(mine.points, other.points)
                if isinstance(mine, CollisionHull)
                else mine == other
            )
            assert same, name
