"""What docs/openvima_small.md says in names and settings is so, its marks can be filled, its figure drawn."""

import re
import runpy
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")


from openvima.policies.bundled import BUNDLED, SMALL
from openvima.policies.checkpoint import read_info
from openvima.policies.parameter_counts import policy_size
from openvima.policies.pointer.candidates import GridCandidates
from openvima.training.recipes import RECIPES

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
TEXT = (DOCS / "openvima_small.md").read_text(encoding="utf-8")
MARKS = {
    *(f"{name}-figure" for name in ("animation", "levels", "scaling", "ablations")),
    *("short", "levels", "tasks", "input_ablations", "ablations", "scaling"),
}


def test_every_file_that_the_page_names_is_there() -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", TEXT):
        assert (DOCS / target).exists(), target


@pytest.mark.parametrize("page", ["README.md", "docs/openvima_small.md"])
def test_every_mark_has_an_end_and_a_table_or_figure(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    begun = re.findall(r"<!-- small:(\S+) -->", text)
    assert begun and begun == re.findall(r"<!-- /small:(\S+) -->", text)
    assert set(begun) <= MARKS


def test_numbers_of_the_network_and_its_recipe_are_right() -> None:
    size, recipe = policy_size(read_info(BUNDLED[SMALL].folder).config), RECIPES["small"]
    assert f"{size.parameters.total / 1e6:.1f} million parameters" in TEXT
    assert f"text encoder of {size.parts['prompt'].total / 1e6:.1f} M parameters" in TEXT
    assert f"{len(GridCandidates(1).points_mm)} grid candidates" in TEXT
    assert f"{100 * recipe['augmentation.inverse_dynamics_prob']:g} % of them read as" in TEXT
    page, looks = " ".join(TEXT.split()), recipe["pretraining.appearance_randomization_prob"]
    assert (
        f"probability {looks:g} an object there has a random shape, and with {looks:g} a random texture"
        in page
    )
    assert (
        f"probability {recipe['pretraining.grayscale_prob']:g} the prompt image of an object is gray" in page
    )
    assert f"with {recipe['pretraining.occlusion_prob']:g} gaps are painted over it" in page


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
