"""The reader of the original asset pack; what is in the pack is compared in tests named golden."""

import os
import re
from pathlib import Path

import numpy as np
import pytest

from openvima.catalog import OBJECTS, TEXTURES, CollisionBox, CollisionHull
from openvima.catalog.bodies import block, container, line, square, three_sided_rectangle
from openvima.catalog.mesh_files import parse_obj
from openvima.catalog.original import _SCALES, OriginalAssets
from openvima.catalog.textures import texture_spec
from openvima.errors import AssetError

PACK = Path(os.environ.get("OPENVIMA_REFERENCE_ASSETS", "../shared/reference_assets"))
ASSETS_FOLDER = PACK / "vima_bench/tasks/assets"

needs_pack = pytest.mark.skipif(
    not ASSETS_FOLDER.is_dir(), reason=f"{PACK} is absent; OPENVIMA_REFERENCE_ASSETS names another folder"
)


@pytest.fixture
def pack(tmp_path, monkeypatch) -> OriginalAssets:
    """The pack with an empty cache."""
    monkeypatch.setenv("OPENVIMA_CACHE", str(tmp_path / "cache"))
    return OriginalAssets(PACK)


@needs_pack
def test_golden_pack_is_complete_and_original(pack) -> None:
    assert pack.problems() == []


@needs_pack
def test_golden_meshes_have_the_catalogued_bounds(pack, catalogue) -> None:
    for record in catalogue["objects"]:
        if "bounds_min" not in record:
            continue
        vertices = pack.geometry(record["name"], tuple(record["size_min"])).visual.vertices.reshape(-1, 3)
        np.testing.assert_allclose(vertices.min(axis=0), record["bounds_min"], atol=1e-5)
        np.testing.assert_allclose(vertices.max(axis=0), record["bounds_max"], atol=1e-5)


@needs_pack
def test_golden_file_names_are_those_of_the_catalogue(catalogue) -> None:
    for record in catalogue["textures"]:
        if "file" in record:
            assert texture_spec(record["name"]).original_file == record["file"]


@needs_pack
def test_golden_images_have_the_catalogued_size_and_colour(pack, catalogue) -> None:
    for record in catalogue["textures"]:
        if record["category"] in ("special", "swirl"):
            image = pack.texture(record["name"])
            assert image.shape == (record["height"], record["width"], 3)
            np.testing.assert_allclose(image.mean(axis=(0, 1)), record["mean_rgb"], atol=0.5)


@needs_pack
def test_golden_pack_has_a_sound_shape_for_every_object(pack) -> None:
    for name, spec in OBJECTS.items():
        geometry = pack.geometry(name, spec.size_max)
        visual = geometry.visual
        assert visual.vertices.shape == visual.normals.shape == (*visual.uvs.shape[:2], 3)
        assert np.abs(np.linalg.norm(visual.normals, axis=-1) - 1).max() < 1e-3
        assert visual.uvs.min() >= 0
        assert visual.uvs.max() <= 1
        assert (visual.vertices[..., 2] + geometry.rest_z_m).min() >= -0.00101
        for shape in geometry.collision:
            assert isinstance(shape, CollisionBox) or len(shape.points) >= 4


@needs_pack
def test_golden_bowl_collides_as_14_parts_a_fifth_flatter(pack) -> None:
    geometry = pack.geometry("bowl", OBJECTS["bowl"].size_max)
    assert len(geometry.collision) == 14
    hulls = [shape for shape in geometry.collision if isinstance(shape, CollisionHull)]
    tops = max(hull.points[:, 2].max() for hull in hulls)
    assert tops == pytest.approx(0.8 * geometry.visual.vertices[..., 2].max(), abs=0.001)


@needs_pack
def test_golden_scale_applies_once_and_not_to_normals(pack) -> None:
    spec = OBJECTS["heart"]
    plain = pack.geometry("heart", spec.size_max)
    tall = pack.geometry("heart", spec.size_max, (1.0, 0.5, 2.4))
    np.testing.assert_allclose(tall.visual.vertices, plain.visual.vertices * (1.0, 0.5, 2.4), atol=1e-12)
    np.testing.assert_array_equal(tall.visual.normals, plain.visual.normals)
    assert tall.rest_z_m == 0.0
    boxed = pack.geometry("block", (0.07, 0.07, 0.07), (1.0, 1.0, 2.0))
    assert boxed.rest_z_m == pytest.approx(0.069)


@needs_pack
def test_golden_plain_colours_are_exact(pack) -> None:
    for name, spec in TEXTURES.items():
        if spec.texel is not None:
            assert pack.texture(name).tolist() == [[list(spec.texel)]]
    assert pack.texture("gray").tolist() == [[[186, 176, 172]]]


def test_obj_files_are_cut_into_triangles_with_what_their_faces_name() -> None:
    mesh = parse_obj(
        """
        # a square and, as another object, a triangle without texture and normal
        o one
        v 0 0 0
        v 1 0 0
        v 1 1 0
        v 0 1 0
        vt 0.25 0.5
        vn 0 0.6 0.8
        s off
        f 1/1/1 2/1/1 3/1/1 4/1/1
        o two
        v 0 0 2
        f 1 2 -1
        """,
        "square.obj",
    )
    assert mesh.vertices.tolist() == [
        [[0, 0, 0], [1, 0, 0], [1, 1, 0]],
        [[0, 0, 0], [1, 1, 0], [0, 1, 0]],
        [[0, 0, 0], [1, 0, 0], [0, 0, 2]],
    ]
    assert mesh.normals[:, 0].tolist() == [[0, 0.6, 0.8], [0, 0.6, 0.8], [0, -1, 0]]
    assert mesh.uvs[:, 0].tolist() == [[0.25, 0.5], [0.25, 0.5], [0, 0]]
    assert mesh.parts.tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\n", "no faces"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "damaged"),
        ("v 0 0 x\n", "line 1"),
        ("v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "line 1"),
        ("v 0 0 0\nf 0 0 0\n", "line 2"),
    ],
)
def test_damaged_obj_files_are_reported(text, message) -> None:
    with pytest.raises(AssetError, match=message):
        parse_obj(text, "some.obj")


@pytest.mark.parametrize(
    ("geometry", "low", "high", "rest_z_m"),
    [
        (block((0.07, 0.06, 0.03)), (-0.035, -0.03, -0.015), (0.035, 0.03, 0.015), 0.014),
        (line((0.25, 0.04, 0.5)), (-0.125, -0.02, -0.0005), (0.125, 0.02, 0.0005), 0.0005),
        (square((0.2, 0.04, 0.0)), (-0.12, -0.12, -0.0005), (0.12, 0.12, 0.0005), 0.0),
        (three_sided_rectangle((0.2, 0.3, 0.0)), (-0.17, -0.12, -0.0005), (0.17, 0.1, 0.0005), 0.0),
        (
            container((0.15, 0.17, 0.055)),
            (-0.076, -0.086, -0.026),
            (0.076, 0.086, 0.025),
            0.025,
        ),
    ],
)
def test_bodies_of_boxes_have_their_extents_and_rest_height(geometry, low, high, rest_z_m) -> None:
    vertices = geometry.visual.vertices.reshape(-1, 3)
    np.testing.assert_allclose(vertices.min(axis=0), low, atol=1e-12)
    np.testing.assert_allclose(vertices.max(axis=0), high, atol=1e-12)
    assert geometry.rest_z_m == pytest.approx(rest_z_m)


def test_the_top_of_a_box_shows_the_lower_right_sixteenth_of_its_texture() -> None:
    cube = block((2.0, 2.0, 2.0)).visual
    top = (cube.normals == (0, 0, 1)).all(axis=(1, 2))
    x, y, _ = np.moveaxis(cube.vertices[top], -1, 0)
    expected = np.stack([0.75 + (x + 1) / 8, 0.25 - (y + 1) / 8], axis=-1)
    np.testing.assert_allclose(cube.uvs[top], expected)
    assert cube.uvs[~top].max() <= 0.75


@needs_pack
def test_golden_body_descriptions_name_the_meshes_and_scales_of_the_code() -> None:
    described = {
        "bowl": "bowl/bowl",
        "pallet": "pallet/pallet",
        "frame": "zone/zone",
        "disk": "hanoi/disk-mod",
    }
    for name, file in described.items():
        text = (ASSETS_FOLDER / f"{file}.urdf").read_text()
        mesh, scale = re.findall(r'mesh filename="([^"]+)" scale="([^"]+)"', text)[0]
        metres, _ = _SCALES[name]
        assert OBJECTS[name].original_file == f"{Path(file).parent}/{mesh}"
        assert metres == tuple(float(number) for number in scale.split())
