"""The export as a whole, field by field as the format's documentation and LeRobot's own writer have it."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import openvima
from openvima.cli.main import main
from openvima.data import Dataset, Demonstration, GenerateConfig, generate, lerobot
from openvima.data.lerobot import LerobotConfig, export_lerobot
from openvima.data.lerobot_frames import FrameLayout, dense_trajectory
from openvima.data.records import rollout_oracle
from openvima.data.verification import find_difference
from openvima.env import EnvConfig, TabletopEnv
from openvima.errors import DatasetError
from small_data_sets import contents, frames_of

VIDEO_KEYS = [
    f"observation.images.{name}"
    for name in ("front", "top", "prompt_0_front", "prompt_0_top", "prompt_1_front", "prompt_1_top")
]
STATISTICS = ["min", "max", "mean", "std", "q01", "q10", "q50", "q90", "q99", "count"]
INT64, DOUBLE = pa.int64(), pa.float64()


def table(export: Path, name: str) -> pa.Table:
    return pq.read_table(export / name)


def episodes(export: Path) -> list[dict]:
    return table(export, "meta/episodes/chunk-000/file-000.parquet").to_pylist()


def film(export: Path, key: str) -> np.ndarray:
    return np.stack(frames_of(export / f"videos/{key}/chunk-000/file-000.mp4"))


def test_info_says_what_there_is(export: Path) -> None:
    info = json.loads((export / "meta/info.json").read_text())
    features = info.pop("features")
    assert info == {
        "codebase_version": "v3.0",
        "robot_type": "ur5",
        "total_episodes": 3,
        "total_frames": 6,
        "total_tasks": 2,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": 1,
        "splits": {"train": "0:3"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    assert features["observation.images.top"] == {
        "dtype": "video",
        "shape": [128, 256, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": 128,
            "video.width": 256,
            "video.codec": "h264",
            "video.pix_fmt": "yuv444p",
            "video.is_depth_map": False,
            "video.fps": 1,
            "video.channels": 3,
            "has_audio": False,
        },
    }
    assert features["action"]["shape"] == [12]
    assert features["action"]["names"][:3] == ["pose0_position.x", "pose0_position.y", "pose0_rotation.x"]
    assert features["observation.state"]["names"][-2:] == ["wrist_3", "end_effector"]
    assert features["next.done"] == {"dtype": "bool", "shape": [1], "names": None}
    assert list(features)[-5:] == ["timestamp", "frame_index", "episode_index", "index", "task_index"]


def test_the_video_entry_says_what_the_films_are(export: Path) -> None:
    info = json.loads((export / "meta/info.json").read_text())
    for key in VIDEO_KEYS:
        entry = info["features"][key]["info"]
        with av.open(str(export / f"videos/{key}/chunk-000/file-000.mp4")) as container:
            stream = container.streams.video[0]
            assert stream.codec.name == entry["video.codec"]
            assert stream.codec_context.pix_fmt == entry["video.pix_fmt"]
            assert [stream.height, stream.width, 3] == info["features"][key]["shape"]
            assert len(container.streams) == 1


def test_the_frames_have_the_types_of_the_format(export: Path) -> None:
    assert table(export, "data/chunk-000/file-000.parquet").schema.equals(
        pa.schema(
            {
                "observation.state": pa.list_(pa.float32(), 7),
                "action": pa.list_(pa.float32(), 12),
                "next.reward": pa.float32(),
                "next.done": pa.bool_(),
                "next.success": pa.bool_(),
                "timestamp": pa.float32(),
                "frame_index": INT64,
                "episode_index": INT64,
                "index": INT64,
                "task_index": INT64,
            }
        )
    )


def test_the_frames_are_the_steps(export: Path, demos: list[Demonstration]) -> None:
    frames = table(export, "data/chunk-000/file-000.parquet").to_pylist()
    steps = [(episode, step) for episode, demo in enumerate(demos) for step in range(demo.num_steps)]
    assert len(frames) == len(steps)
    for index, (frame, (episode, step)) in enumerate(zip(frames, steps, strict=True)):
        demo = demos[episode]
        action, is_last = demo.actions[step], step == demo.num_steps - 1
        given = (
            *action.pose0_position,
            *action.pose0_rotation,
            *action.pose1_position,
            *action.pose1_rotation,
        )
        np.testing.assert_array_equal(frame["action"], np.float32(given))
        np.testing.assert_array_equal(frame["observation.state"], [*demo.joint_paths[step][0], 1])
        assert (frame["next.reward"], frame["next.done"], frame["next.success"]) == (is_last,) * 3
        assert (frame["frame_index"], frame["timestamp"]) == (step, step)
        assert (frame["episode_index"], frame["index"]) == (episode, index)
        assert frame["task_index"] == (0, 1, 0)[episode]


def test_a_failure_earns_nothing(
    tmp_path: Path, demos: list[Demonstration], store: Callable[..., Path]
) -> None:
    failed = replace(demos[0], outcome=replace(demos[0].outcome, success=False, failure=True))
    export = export_lerobot(LerobotConfig(store([failed]), tmp_path / "out"))
    frames = table(export, "data/chunk-000/file-000.parquet")
    assert frames["next.done"].to_pylist() == [False, True]
    assert frames["next.success"].to_pylist() == [False, False]
    assert frames["next.reward"].to_pylist() == [0, 0]


def test_the_films_show_the_observations_before_each_step(export: Path, demos: list[Demonstration]) -> None:
    for view in ("front", "top"):
        expected = np.concatenate([demo.rgb[view][: demo.num_steps] for demo in demos])
        read = np.moveaxis(film(export, f"observation.images.{view}"), -1, 1)
        assert np.abs(read.astype(int) - expected).max() <= 2


def test_prompt_images_are_shown_with_each_step_and_black_where_there_are_none(
    export: Path, demos: list[Demonstration]
) -> None:
    read = np.moveaxis(film(export, "observation.images.prompt_1_top"), -1, 1).astype(int)
    for start, demo in ((0, demos[0]), (3, demos[2])):
        expected = demo.prompt.images["image_1"].rgb["top"]
        assert np.abs(read[start : start + demo.num_steps] - expected).max() <= 2
    assert read[2].max() == 0


def test_the_list_of_prompts_has_their_texts_as_the_index_of_pandas(export: Path) -> None:
    tasks = table(export, "meta/tasks.parquet")
    assert tasks.schema.names == ["task_index", "task"]
    assert tasks.schema.types == [INT64, pa.string()]
    assert tasks.to_pydict() == {"task_index": [0, 1], "task": ["{image_0} and {image_1}", "Do nothing."]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_the_list_of_episodes_says_where_everything_is(export: Path) -> None:
    rows = episodes(export)
    assert [row["length"] for row in rows] == [2, 1, 3]
    assert [row["dataset_from_index"] for row in rows] == [0, 2, 3]
    assert [row["dataset_to_index"] for row in rows] == [2, 3, 6]
    assert rows[1]["tasks"] == ["Do nothing."]
    for key in VIDEO_KEYS:
        assert [row[f"videos/{key}/from_timestamp"] for row in rows] == [0, 2, 3]
        assert [row[f"videos/{key}/to_timestamp"] for row in rows] == [2, 3, 6]


def test_the_list_of_episodes_has_the_columns_and_types_of_the_format(export: Path) -> None:
    schema = table(export, "meta/episodes/chunk-000/file-000.parquet").schema
    found = {field.name: field.type for field in schema}
    expected = {
        "episode_index": INT64,
        "tasks": pa.list_(pa.string()),
        "length": INT64,
        "data/chunk_index": INT64,
        "data/file_index": INT64,
        "dataset_from_index": INT64,
        "dataset_to_index": INT64,
        "meta/episodes/chunk_index": INT64,
        "meta/episodes/file_index": INT64,
    }
    for key in VIDEO_KEYS:
        expected |= {f"videos/{key}/{name}_index": INT64 for name in ("chunk", "file")}
        expected |= {f"videos/{key}/{name}_timestamp": DOUBLE for name in ("from", "to")}
        nested = pa.list_(pa.list_(pa.list_(DOUBLE)))
        expected |= {f"stats/{key}/{name}": nested for name in STATISTICS}
        expected[f"stats/{key}/count"] = pa.list_(INT64)
    for feature in table(export, "data/chunk-000/file-000.parquet").schema:
        expected |= {f"stats/{feature.name}/{name}": pa.list_(DOUBLE) for name in STATISTICS}
        expected[f"stats/{feature.name}/count"] = pa.list_(INT64)
        if feature.type in (INT64, pa.bool_()):
            expected |= {f"stats/{feature.name}/{name}": pa.list_(feature.type) for name in ("min", "max")}
    assert found == expected


def test_statistics_are_of_an_episode_and_of_all(export: Path, demos: list[Demonstration]) -> None:
    frames = table(export, "data/chunk-000/file-000.parquet")
    actions = np.array(frames["action"].to_pylist())
    overall = json.loads((export / "meta/stats.json").read_text())
    assert set(overall) == {*VIDEO_KEYS, *frames.schema.names}
    assert list(overall["action"]) == STATISTICS
    np.testing.assert_allclose(overall["action"]["mean"], actions.mean(axis=0))
    np.testing.assert_allclose(overall["action"]["std"], actions.std(axis=0))
    assert overall["action"]["count"] == [6]
    np.testing.assert_allclose(episodes(export)[2]["stats/action/mean"], actions[3:].mean(axis=0))
    pixels = np.concatenate([demo.rgb["top"][: demo.num_steps] for demo in demos]) / 255
    mean = pixels.mean(axis=(0, 2, 3))
    np.testing.assert_allclose(np.ravel(overall["observation.images.top"]["mean"]), mean)
    assert overall["observation.images.top"]["count"] == [6]


def test_the_origin_of_each_episode_is_kept_beside(export: Path, demos: list[Demonstration]) -> None:
    rows = table(export, "meta/openvima.parquet").to_pylist()
    assert [row["content_hash"] for row in rows] == [demo.content_hash() for demo in demos]
    assert [(row["episode_index"], row["task"], row["seed"]) for row in rows] == [
        (index, "stack", index) for index in range(3)
    ]
    origin = json.loads((export / "meta/openvima.json").read_text())
    assert origin["source"]["versions"] == demos[0].versions
    assert set(origin["versions"]) == {"openvima", "av", "pyarrow"}


def test_large_exports_are_spread_over_several_files(
    tmp_path: Path,
    made_up: Callable[..., Demonstration],
    store: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = store([replace(made_up(seed, num_steps=4, num_images=0), joint_paths=()) for seed in range(5)])
    monkeypatch.setattr(lerobot, "EPISODES_PER_FILE", 2)
    export = export_lerobot(LerobotConfig(data, tmp_path / "out"))
    for pattern in ("data", "meta/episodes"):
        tables = [pq.read_table(file) for file in sorted((export / pattern).rglob("*.parquet"))]
        numbers = [number for found in tables for number in found["episode_index"].to_pylist()]
        assert len(tables) == 3 and numbers == sorted(numbers) and set(numbers) == set(range(5))
    rows, key = [row for found in tables for row in found.to_pylist()], "observation.images.front"
    files = sorted((export / "videos" / key).rglob("*.mp4"))
    assert len(files) == 3
    for row in rows:
        path = files[row[f"videos/{key}/file_index"]]
        start = int(row[f"videos/{key}/from_timestamp"])
        frames = frames_of(path)
        shown = made_up(row["episode_index"], num_steps=4, num_images=0).rgb["front"]
        assert np.abs(np.moveaxis(frames[start], -1, 0).astype(int) - shown[0]).max() <= 2


def test_without_joint_paths_the_state_is_the_tool_alone(
    tmp_path: Path, demos: list[Demonstration], store: Callable[..., Path]
) -> None:
    first, second, third = demos
    without = [first, replace(second, joint_paths=()), third]
    export = export_lerobot(LerobotConfig(store(without), tmp_path / "out"))
    frames = table(export, "data/chunk-000/file-000.parquet")
    assert frames["observation.state"].type == pa.float32()
    assert frames["observation.state"].to_pylist() == [1.0] * 6
    info = json.loads((export / "meta/info.json").read_text())
    assert info["features"]["observation.state"]["names"] == ["end_effector"]


def test_a_second_export_has_the_same_bytes_and_is_replaced_only_by_force(
    tmp_path: Path, source: Path, export: Path
) -> None:
    again = export_lerobot(LerobotConfig(source, tmp_path / "again"))
    assert contents(again) == contents(export)
    config = LerobotConfig(source, again, pixels="yuv420p")
    with pytest.raises(DatasetError, match="is not empty"):
        export_lerobot(config)
    assert contents(again) == contents(export)
    export_lerobot(replace(config, force=True))
    assert contents(again) != contents(export)


def test_the_command_exports_and_names_the_folder(
    tmp_path: Path, source: Path, export: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "by command"
    assert main(["data", "export-lerobot", str(source), str(out), "--tasks", "stack"]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    differing = {name for name, content in contents(out).items() if (export / name).read_bytes() != content}
    assert differing == {"meta/openvima.json"}  # which names the tasks that were asked for


def test_a_policy_sees_the_exported_states_when_it_acts(tmp_path: Path, store: Callable[..., Path]) -> None:
    env = TabletopEnv("manipulate_old_neighbor", modalities=("joints",))
    demo = rollout_oracle(TabletopEnv("manipulate_old_neighbor"), 1)
    assert demo.num_steps > 1
    export_lerobot(LerobotConfig(store([demo]), tmp_path / "out"))
    states = table(tmp_path / "out", "data/chunk-000/file-000.parquet")["observation.state"].to_pylist()
    observation, _ = env.reset(seed=1)
    for action, state in zip(demo.actions, states, strict=True):
        assert [*observation["joints"].tolist(), observation["ee"]] == state
        observation, *_ = env.step(action)


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
    layout = FrameLayout(len(demo.prompt.images), True, "end_effector")
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
    path = demo.joint_paths[0] + 1e-3
    demo = replace(demo, joint_paths=(path, *demo.joint_paths[1:]))
    with pytest.raises(DatasetError, match=r"rotate, seed \d+: the path of step 0 differs"):
        dense_trajectory(demo, CONTROL)


def test_the_manifest_names_the_control(data) -> None:
    assert Dataset(data).manifest["config"]["control"] == "end_effector"
    with pytest.raises(DatasetError, match="control is 'end_effector' there and 'primitives' here"):
        generate(GenerateConfig(data, ("rotate",), 1))
