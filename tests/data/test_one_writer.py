"""A data folder has one writer; disjoint ranges of shards have one each. A full disk leaves nothing half."""

import errno
from collections.abc import Callable
from pathlib import Path

import pytest

from openvima.cli.main import main
from openvima.data import Dataset, Demonstration, generate
from openvima.data.encoding import ShardInfo
from openvima.data.lerobot import LerobotConfig, export_lerobot
from openvima.data.object_cache import open_object_cache
from openvima.data.subsets import MergeConfig, Splits, SubsetConfig, merge, sample, split
from openvima.data.verification import VerifyConfig, verify
from openvima.errors import FolderLockedError
from small_data_sets import config, contents, with_plain_images, write_folder
from worker_jobs import holding

NO_REPLAY = VerifyConfig(replay=0)


@pytest.fixture
def source(tmp_path: Path, made_up: Callable[..., Demonstration], info: ShardInfo) -> Path:
    return write_folder(tmp_path / "source", info, [[with_plain_images(made_up(seed)) for seed in range(3)]])


def writers(source: Path, out: Path) -> dict[str, Callable[[], object]]:
    """All commands that write a folder as a whole."""
    return {
        "generate": lambda: generate(config(out)),
        "merge": lambda: merge(MergeConfig((source,), out)),
        "sample": lambda: sample(SubsetConfig(source, out), 1.0),
        "split": lambda: split(SubsetConfig(source, out), Splits({"a": 0.5, "b": 0.5})),
        "export": lambda: export_lerobot(LerobotConfig(source, out)),
    }


def test_a_second_writer_is_refused_and_changes_nothing(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with holding(out) as process:
        before = contents(out)
        for write in writers(source, out).values():
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


def test_the_command_ends_with_one_line_and_status_1(source: Path, tmp_path: Path, capsys) -> None:
    with holding(tmp_path / "out"):
        assert main(["data", "merge", str(source), str(tmp_path / "out")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "FolderLockedError" in line
    assert "Wait for it, stop it, or give another folder." in line


def test_disjoint_ranges_are_written_together_and_finished_by_the_last(tmp_path: Path) -> None:
    whole = contents(generate(config(tmp_path / "whole")))
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
    assert contents(out) == whole


def test_a_finished_set_is_left_to_whoever_finishes_it(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("openvima.data.generation.FINISH_S", 0.3)
    whole = contents(generate(config(tmp_path / "out")))
    (tmp_path / "out" / "dataset.json").unlink()
    with holding(tmp_path / "out", 2, 4), pytest.raises(FolderLockedError):
        generate(config(tmp_path / "out", shard_range=(0, 2)))
    generate(config(tmp_path / "out", shard_range=(0, 2)))
    assert contents(tmp_path / "out") == whole


@pytest.mark.parametrize("name", ["merge", "sample", "split", "export"])
def test_a_full_disk_ends_in_one_line_and_leaves_nothing_half_written(
    source: Path, tmp_path: Path, monkeypatch, name: str
) -> None:
    out, before = tmp_path / "out", contents(tmp_path)

    def full(*arguments: object, **options: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("openvima.data.shard._Sink.write", full)
    monkeypatch.setattr("shutil.copyfile", full)
    monkeypatch.setattr("openvima.data.lerobot_files.pq.ParquetWriter.write_table", full)
    with pytest.raises(OSError, match="No space left") as found:
        writers(source, out)[name]()
    assert str(found.value.filename).startswith(str(out))
    assert contents(tmp_path) == before
    assert not out.exists()
