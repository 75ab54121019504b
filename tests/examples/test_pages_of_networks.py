"""What the pages of networks say in code and numbers is so, and their figures can be drawn."""

import json
import re
import runpy
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")

import torch

from findings import LEVELS, Findings
from openvima.cli.detector import COMMANDS
from openvima.detector.config import detector_config
from openvima.detector.network import MaskRCNN
from openvima.policies import preset
from openvima.policies.build import count_parameters, outline_network
from openvima.policies.naming import BUNDLED, SMALL
from openvima.policies.pointer.candidates import GridCandidates
from openvima.training.recipes import RECIPES
from publish import _FIGURES, OUT, weights_tables
from tables import tables

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
DETECTOR, MIDAS, POLICIES, OPENVIMA_SMALL = (
    (DOCS / f"{page}.md").read_text(encoding="utf-8")
    for page in ("detector", "midas", "policies", "openvima_small")
)
MARKS = {
    *(f"{name}-figure" for name in _FIGURES),
    *(*weights_tables(BUNDLED[SMALL]), *tables(Findings({}), {})),
}


def draw(name: str, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(str(DOCS / "images"))
    monkeypatch.delitem(sys.modules, "policy", raising=False)
    figure = runpy.run_path(str(DOCS / "images" / f"{name}.py"))["draw"]()
    sys.modules.pop("policy", None)
    return figure


def test_the_page_names_every_command_of_the_detector() -> None:
    assert set(re.findall(r"^openvima detector (\w+)", DETECTOR, re.MULTILINE)) == COMMANDS.keys()


def test_the_sizes_of_detectors_are_those_of_the_networks() -> None:
    counts = {}
    for name in ("small", "resnet50"):
        with torch.device("meta"):
            network = MaskRCNN(detector_config(name))
        counts[name] = sum(parameter.numel() for parameter in network.parameters()) / 1e6
    assert f"{counts['small']:.2f} M, {4 * counts['small']:.1f} MB" in DETECTOR
    assert f"| {counts['resnet50']:.0f} M |" in DETECTOR
    assert ", ".join(f"{size:g}" for size in detector_config("small").anchor_sizes) in DETECTOR


@pytest.mark.slow
def test_the_code_of_the_policies_runs_from_top_to_bottom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for kind, code in re.findall(r"^```python(.*?)\n(.*?)^```", POLICIES, flags=re.MULTILINE | re.DOTALL):
        if kind.strip() == "no-run":  # needs downloads; its imports are tried all the same
            code = "\n".join(line for line in code.splitlines() if line.startswith("from "))
        exec(compile(code, "policies.md", "exec"), names)
    assert {"policy", "MyDetector", "load_t5"} <= names.keys()


def test_the_table_of_sizes_is_that_of_the_presets() -> None:
    rows = re.findall(r"^\| `([\w-]+)` \| (\d.*) \|$", POLICIES, flags=re.MULTILINE)
    assert {name for name, _ in rows} > {f"vima-{size}" for size in ("2m", "9m", "200m")}
    for name, row in rows:
        config = preset(name)
        decoder, count = config.decoder, count_parameters(outline_network(config))["total"]
        millions = [f"{number / 1e6:.2f}" for number in (count.total, count.trainable)]
        sizes = (decoder.width, decoder.num_layers, decoder.num_heads)
        assert row.split(" | ") == [*map(str, sizes), *millions]


def test_every_recipe_that_the_page_of_midas_names_is_there() -> None:
    assert set(re.findall(r"^\| `(midas-[a-z-]+[a-z])` \| [^\d]", MIDAS, flags=re.MULTILINE)) <= {*RECIPES}


@pytest.mark.parametrize("page", ["README.md", "docs/openvima_small.md", BUNDLED[SMALL] / "MODEL_CARD.md"])
def test_every_mark_has_an_end_and_a_table_or_figure(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    begun = re.findall(r"<!-- small:(\S+) -->", text)
    assert begun and begun == re.findall(r"<!-- /small:(\S+) -->", text)
    assert set(begun) <= MARKS


def test_numbers_of_openvima_small_are_between_marks() -> None:
    outside = re.sub(r"<!-- small:(\S+) -->.*?<!-- /small:\1 -->", "", OPENVIMA_SMALL, flags=re.DOTALL)
    assert not re.search(r"\d(\.\d+)? ?(%|points|M\b|million)", outside)
    assert f"{len(GridCandidates(1).points_mm)} grid candidates" in OPENVIMA_SMALL


def readme_scores(policy: str) -> list[str]:
    """Return the four success rates of a policy in the table of README.md."""
    (row,) = re.findall(rf"^\| `{policy}`.*$", (ROOT / "README.md").read_text("utf-8"), re.MULTILINE)
    return row.strip(" |").split(" | ")[1:5]


def test_the_readme_has_the_scores_of_the_record_and_of_the_guide() -> None:
    record = json.loads((ROOT / OUT).with_suffix(".json").read_text("utf-8"))
    means = {each["level"]: each["mean"] for each in record["scores"]["simulator"]["levels"]}
    assert readme_scores("openvima-small") == [f"{100 * means[level]:.1f}" for level in LEVELS]
    (row,) = re.findall(
        r"^\| VIMA, trained here.*$", (DOCS / "train_vima.md").read_text("utf-8"), re.MULTILINE
    )
    assert readme_scores("openvima-vima") == row.strip(" |").split(" | ")[1:5]


@pytest.mark.parametrize(
    ("name", "num_images", "counts"),
    [
        # VIMA: 4 crops of the prompt, 4 views, 12 crops; Gato: 64 patches; the others: 4 pairs of frames each
        ("policy", (4 + 4 + 12) + 64 + 2 * 4, {"put": 4, "output: 12 action bins": 2}),
        # 4 crops of the prompt and 6 of the step; 3 frames, and the 6 objects of each in both views; those of
        # two prompts in context, with an observation of each
        ("midas", 4 + 6 + 3 + 3 * 12 + 7, {"qw₁": 2, "motion": 1}),
        # one object in the prompt and two in view, two crops each; its scene, two views, two top views
        ("openvima_small_network", 2 + 4 + 1 + 2 + 2, {"query": 1, "restore": 1}),
    ],
)
def test_the_figures_of_networks_show_every_crop_patch_and_component(
    name: str, num_images: int, counts: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    (axes,) = draw(name, monkeypatch).axes
    assert len(axes.images) == num_images
    texts = [text.get_text() for text in axes.texts]
    assert {text: texts.count(text) for text in counts} == counts


def test_the_figure_of_the_detector_shows_anchors_grids_and_masks() -> None:
    pytest.importorskip("matplotlib")
    names = runpy.run_path(str(DOCS / "images" / "detector.py"))
    figure, num_objects = names["draw"](), len(names["frame"]().boxes)
    anchors, grids, masks = figure.axes
    assert len(anchors.patches) > num_objects > 1
    assert len(grids.collections) == 2 * num_objects  # lines in two directions
    assert len(masks.images) == 1 + num_objects
