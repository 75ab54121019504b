"""The page that shows all objects and textures."""

import html
import re

import pytest

from openvima.catalog import OBJECTS, TEXTURES, load_assets
from openvima.catalog.procedural import ProceduralAssets
from openvima.errors import AssetError
from openvima.render.gallery import write_gallery


def cards(page) -> dict[str, str]:
    text = html.unescape(page.read_text(encoding="utf-8"))
    return dict(re.findall(r'<article class="card"><h3>([^<]+)</h3>(.*?)</article>', text, flags=re.DOTALL))


@pytest.mark.slow
def test_the_page_has_a_card_with_two_pictures_for_every_object_and_texture(tmp_path) -> None:
    seen = []
    page, problems = write_gallery(tmp_path, load_assets(), report=lambda *now: seen.append(now[:2]))
    assert problems == () and page == tmp_path / "index.html"
    found = cards(page)
    assert list(found) == [*OBJECTS, *TEXTURES, "gray"]
    assert {card.count("data:image/png") for card in found.values()} == {2}
    assert "9.0 × 10.3 × 3.3 cm" in found["letter A"]
    assert seen[-1] == (len(OBJECTS) + len(TEXTURES) + 1,) * 2


class _Incomplete(ProceduralAssets):
    """A pack without stripes and hearts."""

    def texture(self, texture_name: str):
        if "stripe" in texture_name:
            raise AssetError(f"{texture_name} is missing")
        return super().texture(texture_name)

    def geometry(self, object_name, size, scale=(1.0, 1.0, 1.0)):
        if object_name == "heart":
            raise AssetError("kitting/heart.obj is missing")
        return super().geometry(object_name, size, scale)


@pytest.mark.slow
def test_what_a_pack_lacks_is_reported_and_the_rest_is_shown(tmp_path) -> None:
    page, problems = write_gallery(tmp_path, _Incomplete())
    assert "kitting/heart.obj is missing" in problems and "red and blue stripe is missing" in problems
    assert "heart is missing" in cards(page)["heart"] and "data:" in cards(page)["star"]
