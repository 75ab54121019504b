"""Large pictures of single objects, and the page that shows them all."""

import html
import re

import numpy as np
import pytest

from openvima.catalog import OBJECTS, TEXTURES, load_assets
from openvima.render import Rasteriser, gallery
from openvima.render.gallery import PICTURES, draw_thumbnail, write_gallery


@pytest.fixture(scope="module")
def rasteriser() -> Rasteriser:
    return Rasteriser(load_assets())


@pytest.mark.parametrize("view", ["front", "top"])
@pytest.mark.parametrize("name", list(OBJECTS))
def test_every_object_fills_its_portrait_and_none_is_cut_off(rasteriser, name, view) -> None:
    opacity = draw_thumbnail(rasteriser, name, "tiger", view)[..., 3]
    assert opacity.shape == (240, 320)
    border = np.concatenate([opacity[0], opacity[-1], opacity[:, 0], opacity[:, -1]])
    assert not border.any()
    rows, columns = np.flatnonzero(opacity.any(axis=1)), np.flatnonzero(opacity.any(axis=0))
    assert max(np.ptp(rows) / 240, np.ptp(columns) / 320) > 0.85
    assert abs(rows[0] + rows[-1] - 239) <= 2 and abs(columns[0] + columns[-1] - 319) <= 2


def test_a_portrait_has_the_lit_colours_of_its_texture(rasteriser) -> None:
    picture = draw_thumbnail(rasteriser, "block", "red", "top", detail=2)
    assert picture.shape == (480, 640, 4)
    assert picture[240, 320].tolist() == [239, 81, 83, 255]  # 0.93967 of red, as light from above gives
    assert picture[5, 5].tolist() == [0, 0, 0, 0]


def test_letters_stand_upright_and_a_hole_is_transparent(rasteriser) -> None:
    letter = draw_thumbnail(rasteriser, "letter A", "blue", "top")[..., 3]
    assert letter[:80].astype(bool).sum() < letter[160:].astype(bool).sum()  # narrow above, wide below
    assert draw_thumbnail(rasteriser, "ring", "blue", "top")[120, 160, 3] == 0


@pytest.fixture
def quick_portraits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Portraits of one pixel that still need shape and texture."""

    def one_pixel(rasteriser, object_name, texture_name, view, *, detail) -> np.ndarray:
        rasteriser.assets.geometry(object_name, OBJECTS[object_name].size_max)
        rasteriser.assets.texture(texture_name)
        return np.zeros((1, 1, 4), np.uint8)

    monkeypatch.setattr(gallery, "draw_thumbnail", one_pixel)


@pytest.mark.slow
def test_the_page_names_every_object_and_texture_and_all_its_pictures_exist(
    tmp_path, quick_portraits
) -> None:
    seen = []
    page, problems = write_gallery(
        tmp_path, load_assets(), report=lambda done, total, _: seen.append((done, total))
    )
    assert problems == ()
    assert page == tmp_path / "index.html"
    text = html.unescape(page.read_text(encoding="utf-8"))
    titles = re.findall(r'<article class="card" id="[^"]+"><h3>([^<]+)</h3>', text)
    assert titles[: len(OBJECTS)] == list(OBJECTS)
    assert sorted(titles[len(OBJECTS) :]) == sorted([*TEXTURES, "gray"])
    sources = re.findall(r'<img src="([^"]+)"', text)
    assert len(sources) == len(OBJECTS) * 2 + (len(TEXTURES) + 1) * 2
    assert {f"{PICTURES}/{file.name}" for file in (tmp_path / PICTURES).iterdir()} == set(sources)
    assert seen[-1] == (len(OBJECTS) + len(TEXTURES) + 1,) * 2
    assert "http" not in text.replace("http://www.w3.org", "")


@pytest.mark.slow
def test_the_page_says_where_things_are_used(tmp_path, quick_portraits) -> None:
    text = write_gallery(tmp_path, load_assets())[0].read_text(encoding="utf-8")
    cards = {card.split("</h3>")[0].split("<h3>")[1]: card for card in text.split("<article")[1:]}
    assert 'class="on" title="visual_manipulation' not in cards["pallet"].split("L3")[0]
    assert 'class="on"' not in cards["disk"] and 'class="on"' in cards["pallet"]
    assert "D_train" in cards["letter A"] and "9.0 × 10.3 × 3.3 cm" in cards["letter A"]
    assert "78, 121, 167" in cards["blue"] and "C2" in cards["blue"]
    assert "256 × 256 pixels" in cards["tiger"]
