"""What docs/openvima_small.md says in names and settings is so, its marks can be filled, its figure drawn."""

import re
import runpy
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")


from findings import Findings
from openvima.policies.naming import BUNDLED, SMALL
from openvima.policies.pointer.candidates import GridCandidates
from publish import _FIGURES, weights_tables
from tables import tables

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
CARD = BUNDLED[SMALL].model_card
TEXT = (DOCS / "openvima_small.md").read_text(encoding="utf-8")
MARKS = {
    *(f"{name}-figure" for name in _FIGURES),
    *(*weights_tables(BUNDLED[SMALL].folder), *tables(Findings({}), {})),
}


def test_every_file_that_the_page_names_is_there() -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", TEXT):
        assert (DOCS / target).exists(), target


@pytest.mark.parametrize("page", ["README.md", "docs/openvima_small.md", CARD])
def test_every_mark_has_an_end_and_a_table_or_figure(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    begun = re.findall(r"<!-- small:(\S+) -->", text)
    assert begun and begun == re.findall(r"<!-- /small:(\S+) -->", text)
    assert set(begun) <= MARKS


def test_numbers_of_the_page_are_between_marks() -> None:
    outside = re.sub(r"<!-- small:(\S+) -->.*?<!-- /small:\1 -->", "", TEXT, flags=re.DOTALL)
    assert not re.search(r"\d(\.\d+)? ?(%|points|M\b|million)", outside)
    assert f"{len(GridCandidates(1).points_mm)} grid candidates" in TEXT


def test_the_figure_shows_every_crop_and_view(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(str(DOCS / "images"))
    monkeypatch.delitem(sys.modules, "policy", raising=False)
    figure = runpy.run_path(str(DOCS / "images" / "openvima_small_network.py"))["draw"]()
    sys.modules.pop("policy", None)
    (axes,) = figure.axes
    # one object in the prompt and two in view, two crops each; the prompt's scene, two views, two top views
    assert len(axes.images) == 2 + 4 + 1 + 2 + 2
    assert {"query", "restore"} <= {text.get_text() for text in axes.texts}
