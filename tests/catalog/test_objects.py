"""Objects and textures of the catalogue."""

import hashlib
import json
import math
from pathlib import Path

import numpy as np
import pytest

from openvima.catalog.objects import OBJECTS, object_spec
from openvima.catalog.procedural import procedural_assets
from openvima.catalog.textures import TEXTURES, texture_spec
from openvima.errors import UnknownNameError


def test_there_are_31_objects_with_distinct_names_and_ids():
    assert len(OBJECTS) == 31
    assert len({spec.id for spec in OBJECTS.values()}) == 31
    assert all(name == spec.name for name, spec in OBJECTS.items())


def test_nine_objects_have_no_rotational_symmetry():
    names = {spec.name for spec in OBJECTS.values() if spec.symmetry_rad == 2 * math.pi}
    letters = {f"letter {letter}" for letter in "AEGMRTV"}
    assert names == letters | {"heart", "L-shaped block"}


def test_objects_equal_the_machine_readable_catalogue(catalogue):
    assert [spec.name for spec in OBJECTS.values()] == [record["name"] for record in catalogue["objects"]]
    for record in catalogue["objects"]:
        spec = OBJECTS[record["name"]]
        assert spec.id == record["id"]
        assert spec.kind == record["kind"]
        assert spec.profile == record["profile"]
        assert list(spec.aliases) == record["aliases"]
        assert list(spec.novel_names) == record["novel_names"]
        assert spec.kit_scale == record.get("kit_s")
        assert (spec.symmetry_rad is None) == (record["symmetry_rad"] is None)
        if spec.symmetry_rad is not None:
            assert spec.symmetry_rad == pytest.approx(record["symmetry_rad"], abs=1e-8)
        for ours, theirs in (
            (spec.size_min, "size_min"),
            (spec.size_max, "size_max"),
            (spec.mass_kg, "mass"),
            (spec.friction, "lateral_friction"),
            (spec.rolling_friction, "rolling_friction"),
            (spec.com_offset, "com_offset"),
            (spec.inertia_diag, "inertia_diag"),
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
        assert (spec.id, spec.is_dark, spec.category) == (record["id"], record["dark"], record["category"])
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
