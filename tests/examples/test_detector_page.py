"""What docs/detector.md says in code and numbers is so, and its figure can be drawn."""

import re
import runpy
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")

from openvima.cli.detector import COMMANDS  # noqa: E402
from openvima.detector.config import detector_config  # noqa: E402
from openvima.detector.network import MaskRCNN  # noqa: E402

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "detector.md").read_text(encoding="utf-8")


def test_the_page_names_every_command():
    assert set(re.findall(r"^openvima detector (\w+)", PAGE, re.MULTILINE)) == COMMANDS.keys()


def test_the_sizes_are_those_of_the_networks():
    counts = {}
    for name in ("small", "resnet50"):
        with torch.device("meta"):
            network = MaskRCNN(detector_config(name))
        counts[name] = sum(parameter.numel() for parameter in network.parameters()) / 1e6
    assert f"{counts['small']:.2f} M, {4 * counts['small']:.1f} MB" in PAGE
    assert f"| {counts['resnet50']:.0f} M |" in PAGE
    assert ", ".join(f"{size:g}" for size in detector_config("small").anchor_sizes) in PAGE


def test_the_figure_shows_the_anchors_the_grids_and_the_masks():
    pytest.importorskip("matplotlib")
    names = runpy.run_path(str(DOCS / "images" / "detector.py"))
    figure, num_objects = names["draw"](), len(names["frame"]().boxes)
    anchors, grids, masks = figure.axes
    assert len(anchors.patches) > num_objects > 1
    assert len(grids.collections) == 2 * num_objects  # lines in two directions
    assert len(masks.images) == 1 + num_objects
