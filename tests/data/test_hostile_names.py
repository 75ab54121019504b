"""Names in a data folder are plain names of files in it, or refused before anything is read or written."""

import hashlib
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from openvima.data import Dataset, Demonstration, Shard, ShardWriter
from openvima.data.encoding import ShardInfo
from openvima.data.lerobot import LerobotConfig, export_lerobot
from openvima.data.object_cache import open_object_cache
from openvima.data.subsets import MergeConfig, Splits, SubsetConfig, merge, sample, split
from openvima.data.verification import VerifyConfig, verify
from openvima.errors import DatasetError, OpenVimaError
from small_data_sets import contents, edit_manifest, with_plain_images, write_folder

SHARD = "stack-train-00000.arrow"
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
NO_REPLAY = VerifyConfig(replay=0)


@pytest.fixture
def folder(tmp_path: Path, made_up: Callable[..., Demonstration], info: ShardInfo) -> Path:
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "a.arrow").write_text("precious")
    demos = [with_plain_images(made_up(seed)) for seed in range(2)]
    return write_folder(tmp_path / "data", info, [demos])


def forge(folder: Path, name: str) -> None:
    """Rename the shard in manifest and index, both with valid checksums."""
    index = pq.read_table(folder / "index.parquet")
    place = index.column_names.index("shard")
    index = index.set_column(place, index.schema.field(place), pa.array([name] * len(index)))
    pq.write_table(index, folder / "index.parquet")
    content = (folder / "index.parquet").read_bytes()

    def edit(manifest: dict) -> None:
        manifest["shards"] = {name: manifest["shards"].pop(SHARD)}
        manifest["index"] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}

    edit_manifest(folder, edit)


def commands(folder: Path) -> dict[str, Callable[[], object]]:
    """All that follows the names in a data folder."""
    out = folder.parent / "out"
    return {
        "read": lambda: list(Dataset(folder)),
        "preprocess": lambda: open_object_cache(Dataset(folder)),
        "merge": lambda: merge(MergeConfig((folder,), out)),
        "sample": lambda: sample(SubsetConfig(folder, out), 1.0),
        "split": lambda: split(SubsetConfig(folder, out), Splits({"a": 0.5, "b": 0.5})),
        "export": lambda: export_lerobot(LerobotConfig(folder, out)),
    }


@pytest.mark.parametrize("name", NAMES)
def test_a_name_that_is_none_of_a_file_in_the_folder_is_refused(folder: Path, name: str) -> None:
    forge(folder, name.format(outside=folder.parent / "outside"))
    before = contents(folder.parent)
    for command in commands(folder).values():
        with pytest.raises(DatasetError, match=r"dataset\.json: it names the shard .*, which is no plain"):
            command()
    assert contents(folder.parent) == before
    assert not verify(folder, NO_REPLAY).is_clean
    assert contents(folder.parent) == before


def test_a_link_within_the_folder_is_followed(folder: Path) -> None:
    os.replace(folder / SHARD, folder / "elsewhere")
    (folder / SHARD).symlink_to("elsewhere")
    (folder.parent / "link").symlink_to(folder)
    assert len(list(Dataset(folder.parent / "link"))) == 2


@pytest.mark.parametrize("field", ["task", "level", "domain", "assets"])
def test_a_shard_that_calls_itself_a_path_is_refused(
    tmp_path: Path, info: ShardInfo, made_up: Callable[..., Demonstration], field: str
) -> None:
    path = tmp_path / "a.arrow"
    with ShardWriter(path, replace(info, **{field: "../../outside/x"})) as writer:
        writer.write(with_plain_images(made_up(0)))
    with pytest.raises(DatasetError, match=rf"its {field} is '\.\./\.\./outside/x', which is no plain name"):
        Shard(path)


@pytest.mark.parametrize("change", [{"number": "x"}, {"versions": 3}, {"images": [1]}, {"task": None}])
def test_a_shard_whose_description_has_other_types_is_refused(info: ShardInfo, change: dict) -> None:
    with pytest.raises(OpenVimaError, match="what it says of itself is damaged"):
        ShardInfo.from_metadata(replace(info, **change).to_metadata())
