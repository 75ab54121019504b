"""Demonstrations without images show on reading what the cameras saw, or say why they cannot."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from openvima.data import Demonstration, Shard, ShardWriter, rollout_oracle
from openvima.data.encoding import ShardInfo
from openvima.data.records import package_versions
from openvima.env.config import EnvConfig
from openvima.errors import AssetError, DatasetError
from task_cases import frozen


def info_of(demo: Demonstration, env_config: EnvConfig) -> ShardInfo:
    return ShardInfo(
        demo.task,
        demo.level,
        demo.domain,
        number=0,
        shard_size=4,
        first_seed=0,
        assets=demo.assets,
        versions=demo.versions,
        compat=env_config.compat,
        task_options=env_config.task_options,
        prompts=env_config.prompts,
        images=False,
    )


def stored(path: Path, demo: Demonstration, info: ShardInfo) -> Shard:
    with ShardWriter(path, info) as writer:
        writer.write(demo)
    return Shard(path)


@pytest.fixture(scope="module")
def recorded() -> Demonstration:
    return rollout_oracle(EnvConfig().make("visual_manipulation", "train", domain="train"), 0)


@pytest.mark.parametrize(
    ("task", "level", "env_config"),
    [
        ("visual_manipulation", "L2", EnvConfig()),
        ("visual_manipulation", "train", EnvConfig(task_options="difficulty=medium")),
        ("visual_manipulation", "train", EnvConfig(prompts="mixed,paraphrased")),
        ("rearrange", "train", EnvConfig()),  # a scene in the prompt
        ("twist", "train", EnvConfig()),  # scenes before and after
        ("follow_motion", "L4", EnvConfig()),  # frames of a motion
        ("sweep_without_touching", "L4", EnvConfig(compat=True)),  # the spatula
    ],
)
def test_redrawn_images_are_those_of_the_environment(
    tmp_path: Path, task: str, level: str, env_config: EnvConfig
) -> None:
    demo = rollout_oracle(env_config.make(task, level, domain="train"), 3)
    shard = stored(tmp_path / "a.arrow", demo, info_of(demo, env_config))
    read = shard[0]
    for part in ("rgb", "segm", "prompt"):
        assert frozen(getattr(read, part)) == frozen(getattr(demo, part))
    assert read.content_hash() == demo.content_hash()


def test_files_without_images_are_small(tmp_path: Path, recorded: Demonstration) -> None:
    info = info_of(recorded, EnvConfig())
    stored(tmp_path / "without.arrow", recorded, info)
    stored(tmp_path / "with.arrow", recorded, replace(info, images=True))
    sizes = [(tmp_path / name).stat().st_size for name in ("without.arrow", "with.arrow")]
    assert sizes[0] < 18_000 < sizes[1]


def test_a_difference_names_versions_or_other_causes(tmp_path: Path, recorded: Demonstration) -> None:
    equal, other = info_of(recorded, EnvConfig()), replace(recorded, seed=1)  # the scenes of another seed
    with pytest.raises(DatasetError, match="The task, the asset pack or the file is another one"):
        _ = stored(tmp_path / "a.arrow", other, equal)[0]
    info = replace(equal, versions={**package_versions(), "openvima": "0.0.1"})
    shard = stored(tmp_path / "a.arrow", other, info)
    with pytest.raises(DatasetError) as caught:
        _ = shard[0]
    message = str(caught.value)
    assert "a.arrow, record 0: visual_manipulation of seed 1" in message
    assert f"openvima is '0.0.1' there and '{package_versions()['openvima']}' here" in message
    assert "numpy" not in message


def test_a_task_that_is_gone_is_named(
    tmp_path: Path, made_up: Callable[..., Demonstration], info: ShardInfo
) -> None:
    shard = stored(tmp_path / "a.arrow", made_up(), replace(info, assets="procedural", images=False))
    with pytest.raises(DatasetError, match=r"cannot be rerendered.*'stack'.*openvima is '0' there"):
        _ = shard[0]


def test_a_missing_asset_pack_is_said_to_be_missing(tmp_path: Path, recorded: Demonstration) -> None:
    info = replace(info_of(recorded, EnvConfig()), assets="nowhere")
    with pytest.raises(AssetError, match="nowhere"):
        _ = stored(tmp_path / "a.arrow", recorded, info)[0]
