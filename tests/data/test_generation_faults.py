"""Killed in the middle or on a full disk: no damaged file, nothing finished lost, and the command goes on."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import generation_server
from openvima.cli.main import main
from openvima.data import Dataset, Demonstration, generate
from openvima.data.encoding import ShardInfo
from openvima.data.object_cache import open_object_cache
from openvima.data.verification import VerifyConfig, verify
from openvima.errors import DatasetError, FolderLockedError, StorageError
from small_data_sets import TASKS, config, contents, folder_writers, with_plain_images, write_folder
from worker_jobs import holding

NUM_KILLS = 3  # for each of two beginnings


class Server:
    """The program of `generation_server`."""

    def __init__(self, folder: Path) -> None:
        self.small, self.whole = folder / "small", folder / "whole"
        path = os.pathsep.join(filter(None, sys.path))
        self.process = subprocess.Popen(
            [sys.executable, generation_server.__file__, str(self.small), str(self.whole)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": path},
        )
        assert self._read() == "ready"

    def start(self, folder: Path) -> int:
        """Begin to generate; returns the id of the process."""
        return int(self._ask(str(folder)))

    def wait(self) -> int:
        """Return the exit status of what was started last."""
        return int(self._ask(""))

    def _ask(self, line: str) -> str:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()
        return self._read()

    def _read(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("server"))
    with server.process:  # which closes stdin and waits
        yield server


@pytest.mark.parametrize("begin_with", ["nothing", "less"])
@pytest.mark.slow
def test_killed_at_random_moments_it_ends_up_with_the_same_bytes(
    server: Server, tmp_path: Path, begin_with: str
) -> None:
    rng = np.random.default_rng(["nothing", "less"].index(begin_with))
    expected = contents(server.whole)
    out = tmp_path / "out"
    whole_s = _time_of_a_run(server, tmp_path / "timed")
    num_kills = 0
    while num_kills < NUM_KILLS:
        if not out.exists() and begin_with == "less":
            shutil.copytree(server.small, out)
        there = _whole_shards(out, expected)
        process = server.start(out)
        if num_kills % 2:
            _wait_for_writing(out)
            time.sleep(rng.uniform(0, 0.02))
        else:
            time.sleep(rng.uniform(0, whole_s))
        os.kill(process, signal.SIGKILL)
        if server.wait() == 0:  # it was faster
            assert contents(out) == expected
            shutil.rmtree(out)
            continue
        num_kills += 1
        assert there <= _whole_shards(out, expected)
    server.start(out)
    assert server.wait() == 0
    assert contents(out) == expected
    assert verify(out).problems == ()


def _time_of_a_run(server: Server, folder: Path) -> float:
    start = time.monotonic()
    server.start(folder)
    assert server.wait() == 0
    return time.monotonic() - start


def _wait_for_writing(folder: Path) -> None:
    deadline = time.monotonic() + 120
    while not any(folder.glob(".*.tmp")) and not (folder / "dataset.json").exists():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def _whole_shards(folder: Path, expected: dict[str, bytes]) -> set[str]:
    """Names of the shards that are as they will stay; none may be anything but whole."""
    found = {path.name: path.read_bytes() for path in folder.glob("*.arrow")}
    for name, content in found.items():
        is_smaller = len(content) < len(expected[name]) and content.endswith(b"ARROW1")
        assert content == expected[name] or is_smaller
    return {name for name, content in found.items() if content == expected[name]}


def test_an_extension_stopped_by_hand_leaves_whole_files_and_is_continued(
    whole: Path, tmp_path: Path
) -> None:
    def stop(done: int, total: int, note: str) -> None:
        if done == 3:  # in the middle of the writing of the second shard
            raise KeyboardInterrupt

    generate(config(tmp_path, tasks=("rotate",), episodes=1))
    with pytest.raises(KeyboardInterrupt):
        generate(config(tmp_path), stop)
    assert contents(tmp_path).keys() - {"index.parquet"} == {"rotate-train-00000.arrow"}
    with pytest.raises(DatasetError, match="holds no finished data set"):
        Dataset(tmp_path)
    generate(config(tmp_path))
    assert contents(tmp_path) == contents(whole)


@pytest.mark.parametrize("name", ["index.parquet", "dataset.json", "rotate-train-00001.arrow"])
def test_a_lost_file_is_written_again_and_what_a_killed_writer_left_removed(
    whole: Path, tmp_path: Path, name: str
) -> None:
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    (tmp_path / name).unlink()
    for left in ("rotate-train-00000.arrow", "index.parquet"):
        (tmp_path / f".{left}.123.tmp").write_bytes(b"half")
    if name.endswith(".arrow"):
        with pytest.raises(DatasetError, match=rf"lacks 1 of 4 shards, first {name}"):
            Dataset(tmp_path)
    generate(config(tmp_path))
    assert contents(tmp_path) == contents(whole)


def test_a_truncated_shard_stops_generating_and_reading(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    shard = tmp_path / "rotate-train-00000.arrow"
    shard.write_bytes(shard.read_bytes()[:-1])
    dataset = Dataset(tmp_path)
    with pytest.raises(DatasetError, match="truncated"):
        _ = dataset[0]
    assert dataset[2].task == "rotate"  # of another shard
    with pytest.raises(DatasetError, match="openvima data verify"):
        generate(config(tmp_path))


def test_a_disk_that_cannot_keep_the_bytes_leaves_no_file_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match=r"No space left on device\. 0 of 4 shards are whole"):
        generate(config(tmp_path))
    assert contents(tmp_path) == {}


@pytest.mark.slow
def test_a_full_disk_ends_with_a_message_and_loses_nothing(whole: Path, tmp_path: Path) -> None:
    """A real small disk, mounted where only the commands of this test see it."""
    small_disk = tmp_path / "disk"
    small_disk.mkdir()
    size = sum(map(len, contents(whole).values()))
    command = f"{sys.executable} -m openvima generate --tasks {','.join(TASKS)} --episodes 3 --shard-size 2"
    script = f"""
        mount -t tmpfs -o size={size // 2} tmpfs disk || exit 77
        {command} --workers 2 --out disk/out 2> full.log; echo $? > full.status
        cp -a disk/out full
        mount -o remount,size={4 * size} disk
        {command} --out disk/out 2> enough.log; echo $? > enough.status
        cp -a disk/out enough
        mount -o remount,ro disk
        {command} --episodes 4 --out disk/out 2> read_only.log; echo $? > read_only.status
        cp -a disk/out read_only
    """
    result = subprocess.run(
        ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    if result.returncode == 77 or "unshare" in result.stderr:
        pytest.skip(f"no disk can be mounted here: {result.stderr.strip()}")
    assert (tmp_path / "full.status").read_text().strip() == "1"
    message = (tmp_path / "full.log").read_text().splitlines()[-1]
    assert "cannot write to disk/out: No space left on device" in message
    kept = contents(tmp_path / "full")
    assert 0 < len(kept) < 4
    assert kept.items() <= contents(whole).items()
    assert (tmp_path / "enough.status").read_text().strip() == "0"
    assert contents(tmp_path / "enough") == contents(whole)
    message = (tmp_path / "read_only.log").read_text()
    assert "Read-only file system" in message
    assert (tmp_path / "read_only.status").read_text().strip() == "1", message
    assert contents(tmp_path / "read_only") == contents(whole)


NO_REPLAY = VerifyConfig(replay=0)


@pytest.fixture
def source(tmp_path: Path, made_up: Callable[..., Demonstration], info: ShardInfo) -> Path:
    return write_folder(tmp_path / "source", info, [[with_plain_images(made_up(seed)) for seed in range(3)]])


def test_a_second_writer_is_refused_and_changes_nothing(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with holding(out) as process:
        before = contents(out)
        for write in (lambda: generate(config(out)), *folder_writers(source, out)):
            with pytest.raises(FolderLockedError, match=f"out is being written to by process {process.pid}"):
                write()
        assert contents(out) == before
    with holding(source):
        assert verify(source, NO_REPLAY).is_clean  # reading needs no lock


def test_a_second_process_that_preprocesses_is_refused(source: Path, capsys) -> None:
    dataset = Dataset(source)
    cache = source / "object_cache" / open_object_cache(dataset).folder.name
    before = contents(cache)
    for file in cache.iterdir():
        file.unlink()
    with holding(cache) as process:
        assert main(["data", "preprocess", str(source)]) == 1
        assert f"written to by process {process.pid}" in capsys.readouterr().err
    assert open_object_cache(dataset, timeout_s=60.0).folder == cache
    assert contents(cache) == before


def test_disjoint_ranges_are_written_together_and_finished_by_the_last(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with holding(out, 0, 2):
        generate(config(out, shard_range=(2, 4)))
        leftover = out / ".rotate-train-00000.arrow.123.tmp"
        leftover.write_bytes(b"of the other, which lives")
        generate(config(out, shard_range=(2, 4)))
        assert leftover.exists()
        for shard_range in ((1, 3), None):
            with pytest.raises(FolderLockedError):
                generate(config(out, shard_range=shard_range))
    assert not (out / "dataset.json").exists()
    generate(config(out, shard_range=(0, 2)))
    assert contents(out) == contents(whole)
