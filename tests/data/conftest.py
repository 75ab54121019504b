"""Demonstrations for tests of storage: some of the oracle, and some that no simulation made."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from openvima.data import Demonstration, GenerateConfig, generate
from openvima.data.encoding import ShardInfo
from openvima.scene import (
    Action,
    ObjectRecord,
    Outcome,
    Placement,
    Pose,
    PromptImage,
    RenderedPrompt,
    Scene,
)
from small_data_sets import config

VERSIONS = {"openvima": "0", "numpy": "0"}
INFO = ShardInfo("stack", "train", "train", 0, 3, 0, "none", VERSIONS)


def _made_up(seed: int = 0, *, num_steps: int = 2, num_images: int = 2) -> Demonstration:
    """A demonstration full of random numbers."""
    rng = np.random.default_rng(seed)

    def images(*leading: int, channels: tuple[int, ...] = (3,)) -> dict[str, np.ndarray]:
        shape = (*leading, *channels, 128, 256)
        return {view: rng.integers(0, 256, shape, dtype=np.uint8) for view in ("front", "top")}

    def scene() -> Scene:
        return Scene(tuple(_placement(object_id, rng) for object_id in (5, 6)), "spatula")

    first = scene()
    scenes = [first]
    for _ in range(num_steps):
        scenes.append(first.with_poses({p.id: p.pose for p in scene().placements}))
    names = [f"image_{number}" for number in range(num_images)]
    prompt_images = {
        name: PromptImage(
            name, "scene", images(), images(channels=()), (ObjectRecord(2, "flower", "red swirl"),)
        )
        for name in names
    }
    return Demonstration(
        task="stack",
        level="train",
        domain="train",
        seed=seed,
        num_redraws=3,
        max_steps=num_steps + 2,
        prompt=RenderedPrompt(" and ".join(f"{{{name}}}" for name in names), prompt_images),
        rgb=images(num_steps + 1),
        segm=images(num_steps + 1, channels=()),
        end_effector="spatula",
        actions=tuple(Action.planar((0.3, 0.1), (0.6, -0.2), 0.1 * (k + 1)) for k in range(num_steps)),
        pick_ids=tuple(range(5, 5 + num_steps)),
        place_ids=(-1,) * num_steps,
        objects=tuple(ObjectRecord(p.id, p.object, p.texture) for p in first.placements),
        joint_paths=tuple(rng.random((length, 6), dtype=np.float32) for length in range(num_steps)),
        scenes=tuple(scenes),
        outcome=Outcome(success=True, reason="all goals are met"),
        assets="none",
        versions=VERSIONS,
    )


def _placement(object_id: int, rng: np.random.Generator) -> Placement:
    x, y, z, *quaternion = rng.normal(size=7).tolist()
    qx, qy, qz, qw = quaternion
    pose = Pose((x, y, z), (qx, qy, qz, qw))
    return Placement(object_id, "flower", "red swirl", (0.1, 0.2, 0.3), pose, object_id == 5, (1.0, 2.0, 0.7))


@pytest.fixture(scope="session")
def made_up() -> Callable[..., Demonstration]:
    """A function that makes a demonstration of a seed, `num_steps` and `num_images`."""
    return _made_up


@pytest.fixture(scope="session")
def info() -> ShardInfo:
    return INFO


@pytest.fixture(scope="package")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `config` of `small_data_sets` generates; tests leave it as it is."""
    return generate(config(tmp_path_factory.mktemp("whole")))


@pytest.fixture(scope="package")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five demonstrations of each of two tasks, in shards of two."""
    out = tmp_path_factory.mktemp("object_cache") / "demos"
    return generate(
        GenerateConfig(out=out, tasks=("rotate", "rearrange_then_restore"), episodes=5, shard_size=2)
    )


@pytest.fixture
def copy(demos: Path, tmp_path: Path) -> Path:
    """A copy without an object cache, to be changed."""
    shutil.copytree(demos, tmp_path / "demos", ignore=shutil.ignore_patterns("object_cache"))
    return tmp_path / "demos"
