"""What docs/midas.md says in code and numbers is so, and its figure can be drawn."""

import re
import runpy
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")

from openvima.policies import preset
from openvima.policies.build import policy_size
from openvima.training.recipes import RECIPES

DOCS = Path(__file__).parents[2] / "docs"
TEXT = (DOCS / "midas.md").read_text(encoding="utf-8")


def test_the_code_of_the_page_runs() -> None:
    names: dict[str, object] = {}
    for code in re.findall(r"^```python\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL):
        exec(compile(code, "midas.md", "exec"), names)
    assert names["vima"].decoder == preset("vima-nano").decoder
    plain, vima = names["plain"].head, preset("vima-nano").head
    assert type(plain) is type(vima) and plain.hidden_width == vima.hidden_width


def test_the_table_of_sizes_is_that_of_the_presets() -> None:
    rows = re.findall(r"^\| `(midas-\d*\w+)` \| (\d.*) \|$", TEXT, flags=re.MULTILINE)
    assert len(rows) == 8
    for name, row in rows:
        size = policy_size(preset(name))
        counts = [count.total for count in size.parts.values()]
        counts += [size.parameters.total, size.parameters.trainable]
        millions = [f"{count / 1e6:.2f}" for count in counts]
        assert row.split(" | ") == [str(size.width), str(size.num_layers), str(size.num_heads), *millions]


def test_every_recipe_and_file_that_the_page_names_is_there() -> None:
    assert set(re.findall(r"^\| `(midas-[a-z-]+[a-z])` \| [^\d]", TEXT, flags=re.MULTILINE)) <= {*RECIPES}
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", TEXT):
        assert (DOCS / target).exists(), target


def test_the_figure_shows_every_crop_and_component(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(str(DOCS / "images"))
    monkeypatch.delitem(sys.modules, "policy", raising=False)
    figure = runpy.run_path(str(DOCS / "images" / "midas.py"))["draw"]()
    sys.modules.pop("policy", None)
    (axes,) = figure.axes
    # 4 crops of the prompt and 6 of the step; 3 frames, and the 6 objects of each in both views; those of
    # two prompts in context, with an observation of each
    assert len(axes.images) == 4 + 6 + 3 + 3 * 12 + 7
    texts = [text.get_text() for text in axes.texts]
    assert texts.count("qw₁") == 2 and texts.count("motion") == 1
