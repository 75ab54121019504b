"""The figures of the documentation can be drawn from the code as it is."""

import runpy
from pathlib import Path

import pytest

IMAGES = Path(__file__).parents[2] / "docs" / "images"


def test_the_figure_of_the_policies_shows_every_crop_and_patch() -> None:
    pytest.importorskip("torch")
    pytest.importorskip("matplotlib")
    figure = runpy.run_path(str(IMAGES / "policy.py"))["draw"]()
    (axes,) = figure.axes
    # VIMA: 4 crops of the prompt, 4 views, 12 crops; Gato: 64 patches; the others: 4 pairs of frames each
    assert len(axes.images) == (4 + 4 + 12) + 64 + 2 * 4
    texts = [text.get_text() for text in axes.texts]
    assert texts.count("put") == 4 and texts.count("output: 12 action bins") == 2
