"""Objects and textures of users: what is taken, what is refused, and that nothing built-in changes."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from openvima.catalog import (
    load_assets,
    register_object,
    register_texture,
    registration,
    texture_spec,
)
from openvima.catalog.geometry import CollisionHull
from openvima.catalog.original import OriginalAssets
from openvima.errors import AssetError
from openvima.video.encoder import png
from user_shapes import CORNERS, TRIANGLES, boxes, restored_assets

SIZE = (0.06, 0.04, 0.02)


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    with restored_assets():
        yield


def register_brick(name: str = "brick", **changes: Any) -> None:
    register_object(name, changes.pop("mesh", (CORNERS, TRIANGLES)), **{"size": SIZE, **changes})


def obj_text(corners: np.ndarray = CORNERS, triangles: np.ndarray = TRIANGLES) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in triangles + 1]
    return "\n".join(lines)


def test_an_object_has_the_sampled_size_and_rests_on_the_table() -> None:
    register_brick()
    geometry = load_assets().geometry("brick", (0.12, 0.08, 0.04))
    corners = geometry.visual.vertices.reshape(-1, 3)
    np.testing.assert_allclose(corners.max(axis=0), (0.06, 0.04, 0.02))
    np.testing.assert_allclose(corners.min(axis=0), (-0.06, -0.04, -0.02))
    assert geometry.rest_z_m == 0.02 and not geometry.visual.vertices.flags.writeable
    (hull,) = geometry.collision
    assert isinstance(hull, CollisionHull) and len(hull.points) == 8
    assert (geometry.visual.uvs >= 0).all() and (geometry.visual.uvs <= 1).all()


def test_every_pack_has_the_registered_assets() -> None:
    register_brick()
    register_texture("news", np.full((2, 3, 3), 7, np.uint8))
    original = OriginalAssets.__new__(OriginalAssets)
    for pack in (load_assets(), original):
        assert pack.geometry("brick", SIZE).rest_z_m == 0.01
        assert pack.texture("news").tolist() == [[[7, 7, 7]] * 3] * 2
    assert texture_spec("news").category == "registered"


def test_an_inverted_mesh_is_turned_inside_out() -> None:
    register_brick()
    register_brick("inverted", mesh=(CORNERS, TRIANGLES[:, ::-1]))
    meshes = [load_assets().geometry(name, SIZE).visual for name in ("brick", "inverted")]
    for mesh in meshes:
        middle = mesh.vertices.mean(axis=1)
        assert ((mesh.normals[:, 0] * middle).sum(axis=1) > 0).all()


def test_the_bodies_of_a_hollow_are_those_of_its_collision_mesh(tmp_path: Path) -> None:
    arrays = boxes(((0, 0, 0), (3, 2, 1)), ((0, 0, 0.5), (3, 2, 1.5)))
    file = tmp_path / "parts.obj"
    upper = obj_text(arrays[0][8:], TRIANGLES + 8)
    file.write_text(f"o floor\n{obj_text()}\no wall\n{upper}\n")
    for number, collision in enumerate((file, arrays)):
        register_brick(f"tray {number}", collision=collision)
        assert len(load_assets().geometry(f"tray {number}", SIZE).collision) == 2


def test_registering_an_equal_object_again_changes_nothing_and_another_one_is_refused() -> None:
    register_brick()
    register_brick()
    with pytest.raises(AssetError, match="'brick' is registered already, and differs"):
        register_brick(size=(0.05, 0.05, 0.05))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("bowl", "object 'bowl' already"),
        ("l shaped Block", "object 'L-shaped block' already"),
        ("", "single spaces"),
        (3, "single spaces"),
        ("a  b", "single spaces"),
        ("\x1b[31m", "letters, digits"),
        ("random shape 7", "reserved"),
    ],
)
def test_a_name_is_new_and_plain(name: Any, message: str) -> None:
    with pytest.raises(AssetError, match=message):
        register_brick(name)
    assert name not in registration.REGISTERED_OBJECTS


@pytest.mark.parametrize("name", ["red swirl", "Gray", "dark random texture 1"])
def test_a_texture_has_a_name_of_its_own(name: str) -> None:
    with pytest.raises(AssetError, match="choose another name"):
        register_texture(name, np.zeros((1, 1, 3), np.uint8))


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ((np.zeros((0, 3)), np.zeros((0, 3), int)), "0 triangles; 4 … 20000"),
        ((np.where(CORNERS == 3, np.nan, CORNERS), TRIANGLES), "not finite"),
        ((CORNERS * 1e9, TRIANGLES), "beyond"),
        ((CORNERS, TRIANGLES + 1), "name vertices 1 … 8; it has 0 … 7"),
        ((CORNERS, TRIANGLES - 1), "name vertices -1"),
        ((CORNERS, np.zeros((20_001, 3), int)), "20001 triangles"),
        ((CORNERS * (1, 1, 0), TRIANGLES), "is flat"),
        ((CORNERS, TRIANGLES[1:]), "is open"),
        ((CORNERS, np.concatenate([TRIANGLES[:1, ::-1], TRIANGLES[1:]])), "inverted triangles"),
        ("nowhere.obj", "cannot be read"),
    ],
)
def test_an_unfit_mesh_is_refused_with_the_name_and_the_limit(mesh: Any, message: str) -> None:
    with pytest.raises(AssetError, match=message) as error:
        register_brick(mesh=mesh)
    assert "'brick'" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        obj_text().replace("f 1", "f 99999999999999999999"),
        obj_text() + "\nvt x\n",
        "\x00",
    ],
)
def test_a_hostile_obj_file_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "mesh.obj"
    file.write_text(text)
    with pytest.raises(AssetError):
        register_brick(mesh=file)
    file.write_bytes(b"\xff\xfe" + b"v 0 0 0\n" * 4)
    with pytest.raises(AssetError, match="no UTF-8"):
        register_brick(mesh=file)


def test_an_open_mesh_is_drawn_from_both_sides_on_request() -> None:
    register_brick(mesh=(CORNERS, TRIANGLES[2:]), double_sided=True)
    assert len(load_assets().geometry("brick", SIZE).visual.vertices) == 2 * len(TRIANGLES[2:])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": None}, r"3 × 2 × 1 m; each side must lie within 0.001 … 0.4 m"),
        ({"size": (0.1, 0.1)}, "three lengths"),
        ({"size": (0.1, 0.1, np.nan)}, "each side"),
        ({"size_max": (0.05, 0.05, 0.05)}, "no side may be shorter"),
        ({"symmetry_deg": 0}, "symmetry_deg of object 'brick' is 0; it must be above 0, up to 360"),
        ({"friction": 2}, "within 0.05 … 1"),
        ({"profile": "oval"}, "profile"),
        ({"aliases": ("bowl",)}, "object 'bowl' already"),
        ({"aliases": "tile"}, "aliases of object 'brick' are 'tile'; give a list"),
        ({"collision": (CORNERS + 100, TRIANGLES)}, "part 0 of the collision"),
        ({"collision": (CORNERS * (1, 1, 0), TRIANGLES)}, "is flat"),
    ],
)
def test_numbers_out_of_bounds_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(AssetError, match=message):
        register_brick(**changes)


def test_a_texture_is_read_from_a_png_file(tmp_path: Path) -> None:
    file = tmp_path / "news.png"
    file.write_bytes(png(Image.new("L", (3, 2), 200)))
    register_texture("news", file)
    assert load_assets().texture("news").shape == (2, 3, 3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no readable PNG"),
        (png(Image.new("RGB", (8, 8)))[:40], "no readable PNG"),
        (png(Image.new("RGBA", (8, 8))), "partly transparent"),
        (png(Image.new("RGB", (2000, 1))), "2000 × 1 pixels"),
    ],
    ids=("empty", "truncated", "transparent", "too large"),
)
def test_an_unfit_png_file_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    file = tmp_path / "news.png"
    file.write_bytes(content)
    with pytest.raises(AssetError, match=f"'news'.*{message}"):
        register_texture("news", file)
