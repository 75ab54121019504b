"""Anchors of a cell and of whole levels, against a naive implementation."""

import numpy as np
import pytest

import naive_detection as naive

torch = pytest.importorskip("torch")
from openvima.detector.boxes import cell_anchors, level_anchors, pyramid_anchors  # noqa: E402


def test_the_anchors_of_a_cell_have_one_area_and_three_shapes():
    # sizes 8 · √2 by 8 / √2, 8 by 8, 8 / √2 by 8 · √2
    long, short = 4 * 2**0.5, 2 * 2**0.5
    expected = [[-long, -short, long, short], [-4, -4, 4, 4], [-short, -long, short, long]]
    assert np.allclose(cell_anchors(8.0), expected)


def test_the_anchors_of_a_level_agree_with_the_naive_twin():
    made = level_anchors(20.0, stride=8, height=3, width=5)
    assert np.allclose(made, naive.anchors(20.0, stride=8, height=3, width=5), atol=1e-5)


def test_strides_double_from_level_to_level():
    first, second = pyramid_anchors((16.0, 32.0), [(2, 4), (1, 2)], first_stride=4)
    assert np.allclose(first, naive.anchors(16.0, stride=4, height=2, width=4), atol=1e-5)
    assert np.allclose(second, naive.anchors(32.0, stride=8, height=1, width=2), atol=1e-5)
