"""Small data sets for the export, and one export of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from openvima.data import Demonstration
from openvima.data.encoding import ShardInfo
from openvima.data.lerobot import LerobotConfig, export_lerobot
from openvima.scene import RenderedPrompt
from small_data_sets import write_folder

LENGTHS = (2, 1, 3)  # steps of the episodes of `demos`
NUM_IMAGES = (2, 0, 1)  # images in their prompts


def with_joints(demo: Demonstration) -> Demonstration:
    """The demonstration with a path of three waypoints for each step."""
    rng = np.random.default_rng(demo.seed)
    return replace(demo, joint_paths=tuple(rng.random((3, 6), np.float32) for _ in demo.actions))


@pytest.fixture(scope="package")
def demos(made_up: Callable[..., Demonstration]) -> list[Demonstration]:
    """Three episodes of random pictures; the first and the last have the same prompt."""
    made = [
        with_joints(made_up(seed, num_steps=LENGTHS[seed], num_images=NUM_IMAGES[seed])) for seed in range(3)
    ]
    image = made[2].prompt.images["image_0"]
    prompts = {"image_0": image, "image_1": replace(made[0].prompt.images["image_0"], name="image_1")}
    made[2] = replace(made[2], prompt=RenderedPrompt(made[0].prompt.text, prompts))
    made[1] = replace(made[1], prompt=RenderedPrompt("Do nothing.", {}))
    return made


@pytest.fixture
def store(tmp_path: Path, info: ShardInfo) -> Callable[[Sequence[Demonstration]], Path]:
    """A function that makes a data set of demonstrations."""
    return lambda demos: write_folder(tmp_path / "demos", info, [demos])


@pytest.fixture(scope="package")
def source(tmp_path_factory: pytest.TempPathFactory, info: ShardInfo, demos: list[Demonstration]) -> Path:
    """A data set of `demos`."""
    return write_folder(tmp_path_factory.mktemp("lerobot") / "demos", info, [demos])


@pytest.fixture(scope="package")
def export(source: Path) -> Path:
    """The export of `demos`."""
    return export_lerobot(LerobotConfig(source, source.parent / "out"))
