"""Frames of coloured rectangles, networks small enough to learn them, and a small data set."""

from pathlib import Path

import numpy as np
import pytest

from openvima.data import GenerateConfig, generate
from openvima.detector.config import BackboneConfig, DetectorConfig
from openvima.detector.frames import Frame

TASKS = ("rotate", "sweep_without_exceeding")


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """Six demonstrations of each of two tasks, one with the suction cup and one with the spatula."""
    folder = tmp_path_factory.mktemp("data")
    return generate(GenerateConfig(out=folder / "demos", tasks=TASKS, episodes=6))


@pytest.fixture
def tiny() -> DetectorConfig:
    """The smallest sizes that make sense."""
    backbone = BackboneConfig(
        block="basic", depths=(1, 1), widths=(8, 16), stem_width=8, stem_kernel=3, fpn_width=16
    )
    return DetectorConfig(
        backbone,
        anchor_sizes=(16.0, 32.0),
        box_head_widths=(32,),
        mask_head_widths=(16,),
        rpn_post_nms_top_n=20,
        rpn_pre_nms_top_n=30,
    )


@pytest.fixture
def rectangles():
    """A function that draws two rectangles in an image of 64 × 96 pixels."""

    def draw(seed: int = 0) -> Frame:
        rng = np.random.default_rng(seed)
        rgb = np.full((3, 64, 96), 51, np.uint8)
        boxes, masks = np.zeros((2, 4), np.float32), np.zeros((2, 64, 96), bool)
        for number in range(2):
            left, upper = 4 + 48 * number + int(rng.integers(16)), 4 + int(rng.integers(24))
            width, height = (int(side) for side in rng.integers(14, 28, 2))
            boxes[number] = left, upper, left + width, upper + height
            masks[number, upper : upper + height, left : left + width] = True
            rgb[:, masks[number]] = rng.integers(100, 256, (3, 1))
        return Frame(rgb, boxes, masks)

    return draw
