"""The table of textures: own invariants, and equality with the machine-readable catalogue."""

import pytest

from openvima.catalog.textures import TEXTURES, texture_spec
from openvima.errors import UnknownTextureError


def test_there_are_49_light_and_33_dark_textures():
    assert sum(not spec.is_dark for spec in TEXTURES.values()) == 49
    assert sum(spec.is_dark for spec in TEXTURES.values()) == 33


def test_every_dark_texture_belongs_to_one_light_texture():
    dark = {spec.name for spec in TEXTURES.values() if spec.is_dark}
    assert {spec.dark_variant for spec in TEXTURES.values() if spec.dark_variant} == dark
    for name in dark:
        assert TEXTURES[TEXTURES[name].light_variant].dark_variant == name


def test_an_8_bit_colour_survives_the_unit_interval():
    assert texture_spec("blue").texel == (78, 121, 167)
    assert texture_spec("red").texel == (255, 87, 89)


def test_dark_colours_are_rounded_down():
    assert texture_spec("dark blue").texel == (42, 65, 90)
    assert texture_spec("dark pink").texel == (178, 109, 116)


def test_gray_is_a_texture_but_none_of_the_82():
    assert texture_spec("gray").texel == (186, 176, 172)
    assert "gray" not in TEXTURES


def test_an_unknown_texture_is_refused_with_the_nearest_name():
    with pytest.raises(UnknownTextureError, match="Did you mean 'red swirl'"):
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
