"""A data folder has one writer; disjoint ranges of shards have one each. A full disk leaves nothing half."""

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
