"""Damaged data sets: every accident is found, and reading gives the same content or one clear error."""

import contextlib
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest

from openvima.data import Dataset, Demonstration, Shard, VerifyConfig, verify
from openvima.data.encoding import ShardInfo
from openvima.data.schema import COLUMNS
from openvima.errors import DatasetError
from small_data_sets import (
    edit_manifest,
    read_all,
    with_plain_images,
    write_folder,
)

MadeUp = Callable[..., Demonstration]
NO_REPLAY = VerifyConfig(replay=0)
FIRST = "stack-train-00000.arrow"
SECOND = "stack-train-00001.arrow"


@pytest.fixture
def demos(made_up: MadeUp) -> list[Demonstration]:
    return [with_plain_images(made_up(seed, num_steps=1, num_images=1)) for seed in range(4)]


@pytest.fixture
def folder(tmp_path: Path, info: ShardInfo, demos: list[Demonstration]) -> Path:
    return write_folder(tmp_path / "whole", info, [demos[:2], demos[2:]])


def test_a_whole_data_set_is_clean(folder: Path, demos: list[Demonstration]) -> None:
    assert verify(folder, NO_REPLAY).problems == ()
    assert read_all(folder) == [demo.content_hash() for demo in demos]


@pytest.mark.parametrize("name", ["dataset.json", "index.parquet", FIRST])
@pytest.mark.parametrize("share", [0, 0.1, 0.999])
def test_a_file_that_ends_early_is_found(folder: Path, name: str, share: float) -> None:
    path = folder / name
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert [problem.file for problem in verify(folder, NO_REPLAY).problems] == [name]
    assert read_all(folder) is None


@pytest.mark.parametrize("name", ["dataset.json", "index.parquet", FIRST])
def test_a_file_that_is_missing_is_found(folder: Path, name: str) -> None:
    (folder / name).unlink()
    problem, *others = verify(folder, NO_REPLAY).problems
    assert others == []
    assert (problem.file, problem.cause) == (name, "it is missing")
    with pytest.raises((DatasetError), match=name):
        _ = Dataset(folder)[0]


def test_a_damaged_record_is_named_and_the_others_are_read(folder: Path, demos: list[Demonstration]) -> None:
    path = folder / FIRST
    content = bytearray(path.read_bytes())
    place = Dataset(folder).index.column("offset")[1].as_py() + 5000
    content[place] ^= 1
    path.write_bytes(content)
    problem, *others = verify(folder, NO_REPLAY).problems
    assert others == []
    assert problem.file == FIRST
    assert "bytes are not those that were written" in problem.cause
    assert problem.remedy.startswith("Restore it from a copy, or delete the folder and write it again with")
    dataset = Dataset(folder)
    assert dataset[0].content_hash() == demos[0].content_hash()
    with pytest.raises(DatasetError, match=rf"{FIRST}: record 1 of 2 .*checksum is wrong.*data verify"):
        _ = dataset[1]


def test_shards_that_changed_places_are_found(folder: Path) -> None:
    first, second = (folder / FIRST).read_bytes(), (folder / SECOND).read_bytes()
    (folder / FIRST).write_bytes(second)
    (folder / SECOND).write_bytes(first)
    assert {problem.file for problem in verify(folder, NO_REPLAY).problems} == {FIRST, SECOND}
    with pytest.raises(DatasetError, match=FIRST):
        _ = Dataset(folder)[0]


@pytest.mark.parametrize("name", ["dataset.json", "index.parquet"])
def test_a_file_of_another_data_set_is_found(
    folder: Path, name: str, info: ShardInfo, demos: list[Demonstration]
) -> None:
    other = write_folder(folder.parent / "other", info, [demos[:2], demos[1:2] + demos[3:]])
    shutil.copy(other / name, folder / name)
    assert not verify(folder, NO_REPLAY).is_clean
    with pytest.raises(DatasetError):
        list(Dataset(folder))


@pytest.mark.parametrize(
    ("edit", "cause"),
    [
        (lambda manifest: manifest.update(schema=1), "it has schema 1; this package reads 2"),
        (lambda manifest: manifest.pop("shards"), "it lacks shards"),
    ],
)
def test_a_manifest_of_another_form_is_found(
    folder: Path, edit: Callable[[dict], object], cause: str
) -> None:
    edit_manifest(folder, edit)
    causes = {each.cause for each in verify(folder, NO_REPLAY).problems if each.file == "dataset.json"}
    assert causes == {cause}


def test_a_shard_of_another_version_is_named_with_both(folder: Path) -> None:
    _replace(folder / FIRST, b'"schema": 2', b'"schema": 7')
    with pytest.raises(DatasetError, match=rf"{FIRST}.*version 7; this package reads 2"):
        Shard(folder / FIRST)


def test_nothing_in_a_shard_is_run(folder: Path, tmp_path: Path) -> None:
    """Old versions of pyarrow unpickled the types of fields that say they are made by Python."""
    trap = pickle.dumps(_Trap(tmp_path / "sprung"))
    metadata = {b"ARROW:extension:name": b"arrow.py_extension_type", b"ARROW:extension:metadata": trap}
    shard = Shard(folder / FIRST)
    fields = [field.with_metadata(metadata) if field.name == "seed" else field for field in COLUMNS]
    schema = pa.schema(fields, shard.info.to_metadata())
    batches = [shard.batch(row) for row in range(len(shard))]
    with pa.OSFile(str(folder / FIRST), "wb") as sink, pa.ipc.new_file(sink, schema) as writer:
        for batch in batches:
            writer.write_batch(pa.record_batch(batch.columns, schema=schema))
    assert not verify(folder, NO_REPLAY).is_clean
    with contextlib.suppress(DatasetError):  # older versions of pyarrow show another type
        _ = Shard(folder / FIRST)[0]
    assert not (tmp_path / "sprung").exists()


class _Trap:
    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self._path,)


def _replace(path: Path, before: bytes, after: bytes) -> None:
    content = path.read_bytes()
    assert before in content
    path.write_bytes(content.replace(before, after))
