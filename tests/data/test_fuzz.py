"""Damaged data sets and hostile names: each is found, and reading gives the same content or one error."""

import hashlib
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from openvima.data import Dataset, Demonstration, Shard, ShardWriter, VerifyConfig, verify
from openvima.data.encoding import ShardInfo
from openvima.data.object_cache import open_object_cache
from openvima.errors import DatasetError, OpenVimaError
from small_data_sets import (
    contents,
    edit_manifest,
    flip_bit,
    folder_writers,
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
    flip_bit(folder / FIRST, Dataset(folder).index.column("offset")[1].as_py() + 5000)
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
    with pytest.raises(DatasetError, match=rf"{FIRST}.*version 7; this package reads version 2"):
        Shard(folder / FIRST)


def _replace(path: Path, before: bytes, after: bytes) -> None:
    content = path.read_bytes()
    assert before in content
    path.write_bytes(content.replace(before, after))


NAMES = [
    "../outside/a.arrow",
    "{outside}/a.arrow",
    "sub/a.arrow",
    "..\\a.arrow",
    "C:a.arrow",
    "",
    ".",
    "..",
    "a\0.arrow",
    "a\n.arrow",
    ".hidden.arrow",
    "dataset.json",
    "a" * 300 + ".arrow",
]


def forge(folder: Path, name: str) -> None:
    """Rename the shard in manifest and index, both with valid checksums."""
    index = pq.read_table(folder / "index.parquet")
    place = index.column_names.index("shard")
    index = index.set_column(place, index.schema.field(place), pa.array([name] * len(index)))
    pq.write_table(index, folder / "index.parquet")
    content = (folder / "index.parquet").read_bytes()

    def edit(manifest: dict) -> None:
        manifest["shards"] = {name: manifest["shards"].pop(FIRST)}
        manifest["index"] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}

    edit_manifest(folder, edit)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_that_is_none_of_a_file_in_the_folder_is_refused(folder: Path, name: str) -> None:
    (folder.parent / "outside").mkdir()
    (folder.parent / "outside" / "a.arrow").write_text("precious")
    forge(folder, name.format(outside=folder.parent / "outside"))
    before = contents(folder.parent)
    readers = (lambda: list(Dataset(folder)), lambda: open_object_cache(Dataset(folder)))
    for command in (*readers, *folder_writers(folder, folder.parent / "out")):
        with pytest.raises(DatasetError, match=r"dataset\.json: it names the shard .*, which is no plain"):
            command()
    assert contents(folder.parent) == before
    assert not verify(folder, NO_REPLAY).is_clean
    assert contents(folder.parent) == before


def test_a_link_within_the_folder_is_followed(folder: Path) -> None:
    os.replace(folder / FIRST, folder / "elsewhere")
    (folder / FIRST).symlink_to("elsewhere")
    (folder.parent / "link").symlink_to(folder)
    assert len(list(Dataset(folder.parent / "link"))) == 4


@pytest.mark.parametrize("field", ["task", "level", "domain", "assets"])
def test_a_shard_that_calls_itself_a_path_is_refused(
    tmp_path: Path, info: ShardInfo, made_up: Callable[..., Demonstration], field: str
) -> None:
    path = tmp_path / "a.arrow"
    with ShardWriter(path, replace(info, **{field: "../../outside/x"})) as writer:
        writer.write(with_plain_images(made_up(0)))
    with pytest.raises(DatasetError, match=rf"its {field} is '\.\./\.\./outside/x', which is no plain name"):
        Shard(path)


def test_a_shard_whose_description_has_other_types_is_refused(info: ShardInfo) -> None:
    with pytest.raises(OpenVimaError, match="what it says of itself is damaged"):
        ShardInfo.from_metadata(replace(info, task=None).to_metadata())  # type: ignore[arg-type]
