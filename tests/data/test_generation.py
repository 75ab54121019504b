"""Generating data sets: equal bytes by any road, and clear words when the road is blocked."""

import errno
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.encoding import Skipped
from openvima.data.generation import SEEDS_PER_EPISODE, SPARE_SEEDS, plan
from openvima.env import TabletopEnv
from openvima.errors import (
    ConfigError,
    DatasetError,
    LevelError,
    OracleError,
    SamplingError,
    ShardError,
    UnknownTaskError,
)

TASKS = ("rotate", "sweep_without_exceeding")


def config(out: Path, **changes: object) -> GenerateConfig:
    return replace(GenerateConfig(out=out, tasks=TASKS, episodes=3, shard_size=2), **changes)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate(config(tmp_path_factory.mktemp("whole")))


def test_a_folder_holds_shards_index_and_manifest(whole: Path) -> None:
    shards = [f"{task}-train-{number:05d}.arrow" for task in TASKS for number in (0, 1)]
    assert sorted(contents(whole)) == sorted([*shards, "index.parquet", "dataset.json"])
    manifest = json.loads((whole / "dataset.json").read_text())
    assert manifest["counts"]["episodes"] == 6
    assert [entry["episodes"] for entry in manifest["tasks"].values()] == [3, 3]
    assert manifest["config"]["domain"] == "train"
    assert set(manifest["versions"]) == {"openvima", "mujoco", "numba", "numpy", "pyarrow"}


def test_the_number_of_workers_does_not_change_a_byte(whole: Path, tmp_path: Path) -> None:
    calls = []
    generate(config(tmp_path, workers=2), report=lambda done, total, note: calls.append((done, total)))
    assert contents(tmp_path) == contents(whole)
    assert calls[0] == (0, 6)
    assert calls[-1] == (6, 6)


def test_a_run_stopped_by_hand_leaves_whole_files_and_is_continued(whole: Path, tmp_path: Path) -> None:
    def stop(done: int, total: int, note: str) -> None:
        if done == 3:  # in the middle of the writing of the second shard
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(config(tmp_path), report=stop)
    assert contents(tmp_path).keys() == {"rotate-train-00000.arrow"}
    with pytest.raises(DatasetError, match="not finished"):
        Dataset(tmp_path)
    generate(config(tmp_path))
    assert contents(tmp_path) == contents(whole)


def test_a_run_killed_in_the_middle_is_continued(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = f"generate --tasks {','.join(TASKS)} --episodes 3 --shard-size 2 --workers 2 --out".split()
    process = subprocess.Popen(
        [sys.executable, "-m", "openvima", *words, str(out)], stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 60
    while not any(out.glob("*.arrow")) and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    generate(config(out))
    assert contents(out) == contents(whole)


def test_what_a_killed_writer_left_is_removed(whole: Path, tmp_path: Path) -> None:
    (tmp_path / ".rotate-train-00000.arrow.123.tmp").write_bytes(b"half")
    generate(config(tmp_path))
    assert contents(tmp_path) == contents(whole)


def test_a_finished_folder_is_left_alone(whole: Path) -> None:
    times = {path: path.stat().st_mtime_ns for path in whole.iterdir()}
    generate(config(whole))
    assert {path: path.stat().st_mtime_ns for path in whole.iterdir()} == times


def test_a_lost_shard_is_written_again(whole: Path, tmp_path: Path) -> None:
    for name, content in contents(whole).items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "rotate-train-00001.arrow").unlink()
    with pytest.raises(DatasetError, match=r"lacks 1 of 4 shards, first rotate-train-00001\.arrow"):
        Dataset(tmp_path)
    generate(config(tmp_path))
    assert contents(tmp_path) == contents(whole)


def test_more_episodes_and_tasks_extend_a_folder(whole: Path, tmp_path: Path) -> None:
    generate(config(tmp_path, tasks=("rotate",), episodes=1))
    generate(config(tmp_path))
    assert contents(tmp_path) == contents(whole)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"level": "L2"}, "level is train, asked for is L2"),
        ({"start_seed": 5}, "first_seed is 0, asked for is 5"),
        ({"shard_size": 1}, "shard_size is 2, asked for is 1"),
        ({"episodes": 2}, "not among the 2 shards of 2 episodes"),
        ({"episodes": 1}, "it has 2 episodes, asked for are 1"),
        ({"tasks": ("rotate",)}, "sweep_without_exceeding.*not among"),
    ],
)
def test_another_data_set_in_the_folder_is_not_touched(whole: Path, changes: dict, message: str) -> None:
    before = contents(whole)
    with pytest.raises(DatasetError, match=message):
        generate(config(whole, **changes))
    assert contents(whole) == before


def test_force_replaces_a_data_set(tmp_path: Path) -> None:
    generate(config(tmp_path, tasks=("rotate",), episodes=1))
    (tmp_path / "notes.txt").write_text("mine")
    generate(config(tmp_path, tasks=("rotate",), episodes=1, start_seed=7, force=True))
    assert Dataset(tmp_path)[0].seed >= 7
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_truncated_shard_stops_generating_and_reading(whole: Path, tmp_path: Path) -> None:
    for name, content in contents(whole).items():
        (tmp_path / name).write_bytes(content)
    shard = tmp_path / "rotate-train-00000.arrow"
    shard.write_bytes(shard.read_bytes()[:-1])
    dataset = Dataset(tmp_path)
    with pytest.raises(ShardError, match="truncated"):
        _ = dataset[0]
    assert dataset[2].task == "rotate"  # of another shard
    with pytest.raises(ShardError, match="Delete it"):
        generate(config(tmp_path))


def test_a_full_disk_leaves_no_file_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        generate(config(tmp_path))
    assert contents(tmp_path) == {}


def test_seeds_that_fail_are_skipped_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unlucky = {1: SamplingError("no room"), 2: OracleError("lost sight")}
    reset = TabletopEnv.reset

    def sometimes(env: TabletopEnv, *, seed: int, options: dict | None = None) -> tuple:
        if seed in unlucky:
            raise unlucky[seed]
        return reset(env, seed=seed, options=options)

    monkeypatch.setattr(TabletopEnv, "reset", sometimes)
    dataset = Dataset(generate(config(tmp_path, tasks=("rotate",))))
    assert [demo.seed for demo in dataset] == [0, 3, 2 * SEEDS_PER_EPISODE + SPARE_SEEDS]
    entry = dataset.manifest["tasks"]["rotate"]
    assert entry["skipped"] == {"no_action": 1, "not_sampled": 1}
    assert (entry["seeds_tried"], entry["success_rate"]) == (5, 0.6)


def test_a_task_that_the_oracle_cannot_solve_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "openvima.data.generation.attempt", lambda env, seed: Skipped(seed, "failed", "it fell")
    )
    with pytest.raises(OracleError, match=r"solved 0 of 20 episodes of 'rotate'.*it fell"):
        generate(config(tmp_path))
    assert contents(tmp_path) == {}


def test_blocks_share_no_seeds_and_do_not_depend_on_workers(tmp_path: Path) -> None:
    blocks = plan(config(tmp_path, tasks=("rotate",), episodes=7))
    seeds = [seed for block in blocks for seed in block.seeds]
    assert len(seeds) == len(set(seeds))
    assert [block.episodes for block in blocks] == [2, 2, 2, 1]
    assert plan(config(tmp_path, tasks=("rotate",), episodes=7, workers=5)) == blocks


def test_settings_are_checked_together(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"episodes is 0.*workers is 0"):
        config(tmp_path, episodes=0, workers=0)
    with pytest.raises(UnknownTaskError, match="rotate"):
        generate(config(tmp_path, tasks=("rotat",)))
    with pytest.raises(LevelError):
        generate(config(tmp_path, level="L7"))


@pytest.mark.parametrize(("name", "value"), [("episodes", 10**19), ("start_seed", 2**63), ("workers", 10**6)])
def test_numbers_beyond_all_reason_are_refused(name: str, value: int, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"is {value}; it must lie within"):
        GenerateConfig(out=tmp_path, **{name: value})


def test_every_episode_is_a_solved_one_as_the_environment_shows_it(whole: Path) -> None:
    dataset = Dataset(whole)
    assert len(dataset) == 6
    assert all(demo.outcome.success for demo in dataset)
    demo = dataset[-1]
    env = TabletopEnv(demo.task, level=demo.level, domain=demo.domain)
    observation, _ = env.reset(seed=demo.seed)
    for step, action in enumerate(demo.actions):
        stored = demo.observation(step)
        assert stored["ee"] == observation["ee"]
        assert stored["rgb"]["top"].tobytes() == observation["rgb"]["top"].tobytes()
        assert stored["segm"]["front"].tobytes() == observation["segm"]["front"].tobytes()
        assert demo.scenes[step] == env.scene
        observation, *_ = env.step(action)
    assert env.outcome == demo.outcome
    assert env.prompt.text == demo.prompt.text


def test_a_dataset_can_be_narrowed_to_tasks(whole: Path) -> None:
    dataset = Dataset(whole, tasks=["sweep_without_exceeding"])
    assert len(dataset) == 3
    assert {demo.task for demo in dataset} == {"sweep_without_exceeding"}
    assert dataset.index.num_rows == 3
    with pytest.raises(DatasetError, match="Did you mean 'rotate'"):
        Dataset(whole, tasks=["rotat"])


def test_the_index_tells_where_episodes_are(whole: Path) -> None:
    dataset = Dataset(whole)
    row = dataset.index.slice(2, 1).to_pylist()[0]
    assert (row["task"], row["shard"], row["row"]) == ("rotate", "rotate-train-00001.arrow", 0)
    assert dataset[2].content_hash() == row["content_hash"]
    with pytest.raises(IndexError, match="episode 6 of 6"):
        _ = dataset[6]


def test_a_dataset_can_be_sent_to_another_process(whole: Path) -> None:
    dataset = Dataset(whole, tasks=["rotate"])
    _ = dataset[0]
    copy = pickle.loads(pickle.dumps(dataset))
    assert copy[1].content_hash() == dataset[1].content_hash()
    assert len(copy) == 3


def test_folders_that_are_no_data_set_are_refused(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="there is no folder"):
        Dataset(tmp_path / "gone")
    with pytest.raises(DatasetError, match="holds no data set"):
        Dataset(tmp_path)
    (tmp_path / "dataset.json").write_text("{")
    with pytest.raises(DatasetError, match="damaged"):
        Dataset(tmp_path)
    (tmp_path / "dataset.json").write_text('{"schema": 99}')
    with pytest.raises(DatasetError, match="schema 99"):
        Dataset(tmp_path)
    (tmp_path / "dataset.json").write_bytes((whole / "dataset.json").read_bytes())
    with pytest.raises(DatasetError, match=r"index\.parquet is missing"):
        Dataset(tmp_path)
