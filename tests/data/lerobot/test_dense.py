"""Demonstrations of low-level control: stored as primitives with dense paths, exported command by command."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

import openvima
from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.lerobot import LerobotConfig, export_lerobot
from openvima.data.lerobot_frames import DenseLayout, dense_trajectory
from openvima.data.replay import find_difference
from openvima.env import EnvConfig
from openvima.errors import DatasetError

CONTROL = EnvConfig(control="end_effector")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """One episode of `rotate`."""
    folder = tmp_path_factory.mktemp("dense") / "data"
    return generate(GenerateConfig(folder, ("rotate",), 1, env_config=CONTROL))


def test_the_export_has_a_frame_for_each_command_at_its_true_time(data, tmp_path) -> None:
    (demo,) = Dataset(data)
    num_commands = sum(len(path) - 1 for path in demo.joint_paths)
    out = export_lerobot(LerobotConfig(data, tmp_path / "out"))
    assert json.loads((out / "meta/info.json").read_text())["fps"] == 10
    table = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert table.num_rows == num_commands > 20
    assert np.allclose(np.diff(table["timestamp"].to_numpy()), 0.1)
    env = openvima.make(
        demo.task, level="train", domain="train", control="end_effector", modalities=("rgb", "joints")
    )
    observation, _ = env.reset(seed=demo.seed)
    layout = DenseLayout(num_prompt_images=len(demo.prompt.images), has_joints=True)
    for row in table.select(["observation.state", "action", "next.success"]).to_pylist():
        frame = layout.frame(observation, env.prompt)  # as LeRobot's environments return it
        assert np.array_equal(row["observation.state"], frame["agent_pos"])
        observation, *_, info = env.step(np.array(row["action"], np.float32))
        assert info["success"] == row["next.success"]
    assert info["success"]


def test_a_replay_gives_the_same_bytes_and_another_path_is_noticed(data) -> None:
    (demo,) = Dataset(data)
    env = CONTROL.make(demo.task, demo.level, domain=demo.domain)
    assert find_difference(env, demo) == ""
    demo.joint_paths[0][3, 0] += 1e-3
    with pytest.raises(DatasetError, match=r"rotate, seed \d+: the path of step 0 differs"):
        dense_trajectory(demo, CONTROL)


def test_the_manifest_names_the_control(data) -> None:
    assert Dataset(data).manifest["config"]["control"] == "end_effector"
    with pytest.raises(DatasetError, match="control is end_effector, asked for is primitives"):
        generate(GenerateConfig(data, ("rotate",), 1))
