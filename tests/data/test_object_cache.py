"""The object cache: equal to preprocessing anew, written once, never trusted when damaged or old."""

import os
from dataclasses import fields, is_dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.manifest import joint_hash
from openvima.data.object_cache import CacheFile, ObjectCache, open_object_cache
from openvima.data.preprocessed import preprocess
from openvima.errors import DatasetError
from openvima.perception.preprocessing import KINDS, image_names, split_prompt
from small_data_sets import flip_bit

TASKS = ("rotate", "rearrange_then_restore")


def assert_equal(a: object, b: object) -> None:
    for field in fields(a):
        ours, theirs = getattr(a, field.name), getattr(b, field.name)
        if is_dataclass(ours):
            assert_equal(ours, theirs)
        elif isinstance(ours, np.ndarray):
            assert ours.dtype == theirs.dtype, field.name
            assert np.array_equal(ours, theirs), field.name
        else:
            assert ours == theirs, field.name


@pytest.mark.parametrize("kind", KINDS)
def test_the_cache_holds_what_cutting_anew_would_give(copy: Path, kind) -> None:
    dataset = Dataset(copy)
    cache = open_object_cache(dataset, kind)
    assert len(cache) == len(dataset) == 10
    for demo, episode in zip(dataset, cache, strict=True):
        assert_equal(episode, preprocess(demo, kind))
        assert episode.num_steps == demo.num_steps
    assert np.array_equal(cache.lengths(), [[episode.num_steps, len(episode.objects)] for episode in cache])


def test_several_workers_make_the_same_files(copy: Path, tmp_path: Path) -> None:
    one = open_object_cache(Dataset(copy), folder=tmp_path / "one").folder
    two = open_object_cache(Dataset(copy), folder=tmp_path / "two", workers=2).folder
    files = sorted(path.name for path in one.iterdir())
    assert files == sorted(path.name for path in copy.glob("*.arrow"))
    assert all((one / name).read_bytes() == (two / name).read_bytes() for name in files)


def test_opening_again_makes_nothing_and_extending_makes_what_is_new(copy: Path) -> None:
    cache = open_object_cache(Dataset(copy))
    before = {path.name: path.stat().st_mtime_ns for path in cache.folder.iterdir()}
    calls: list[int] = []
    open_object_cache(Dataset(copy), report=lambda done, total, note: calls.append(total))
    assert calls == []
    generate(GenerateConfig(out=copy, tasks=TASKS, episodes=7, shard_size=2))
    with pytest.raises(DatasetError, match=r"lacks 4 shards, first .* writes them"):
        ObjectCache(Dataset(copy))
    extended = open_object_cache(Dataset(copy), report=lambda done, total, note: calls.append(total))
    assert calls[-1] == 6  # the two short shards of before, and two new ones
    after = {path.name: path.stat().st_mtime_ns for path in cache.folder.iterdir()}
    assert sum(before[name] == after[name] for name in before) == 4
    assert_equal(extended[-1], preprocess(Dataset(copy)[-1], "objects"))


def test_a_dataset_of_some_tasks_has_their_files_only(copy: Path) -> None:
    dataset = Dataset(copy, tasks=["rotate"])
    cache = open_object_cache(dataset)
    assert {path.name.split("-")[0] for path in cache.folder.iterdir()} == {"rotate"}
    assert [episode.seed for episode in cache] == [demo.seed for demo in dataset]
    with pytest.raises(DatasetError, match="lacks 3 shards"):
        ObjectCache(Dataset(copy))


def test_outdated_files_are_noticed(copy: Path) -> None:
    open_object_cache(Dataset(copy, tasks=["rotate"]))
    generate(GenerateConfig(out=copy, tasks=("rotate",), episodes=2, start_seed=50, force=True))
    with pytest.raises(DatasetError, match="lacks 1 shards"):
        ObjectCache(Dataset(copy))
    assert open_object_cache(Dataset(copy))[0].seed == Dataset(copy)[0].seed


def test_a_truncated_file_is_made_anew(copy: Path) -> None:
    dataset = Dataset(copy, tasks=["rotate"])
    path = open_object_cache(dataset).folder / "rotate-train-00000.arrow"
    source = joint_hash(dataset.index.slice(0, 2))
    whole = path.read_bytes()
    for size in (0, 7, 1000, -1):
        path.write_bytes(whole[:size])
        with pytest.raises(DatasetError, match="is no readable file"):
            CacheFile(path, "objects", source)
        with pytest.raises(DatasetError, match="lacks 1 shards"):
            ObjectCache(dataset)
        open_object_cache(dataset)
        assert path.read_bytes() == whole


@pytest.mark.parametrize("part", ["objects.boxes", "images", "text"])
def test_a_damaged_row_is_named_where_others_are_read(copy: Path, part: str) -> None:
    cache = open_object_cache(Dataset(copy, tasks=["rotate"]))
    path = cache.folder / "rotate-train-00000.arrow"
    stored = cache[1].prompt.text.encode() if part == "text" else attrgetter(part)(cache[1]).tobytes()
    content = path.read_bytes()
    start = content.rindex(stored)
    path.unlink()  # the cache has the old file mapped
    path.write_bytes(content[:start] + bytes([content[start] ^ 1]) + content[start + 1 :])
    damaged = ObjectCache(Dataset(copy, tasks=["rotate"]))
    assert_equal(damaged[0], cache[0])
    with pytest.raises(DatasetError, match=r"00000\.arrow .* row 1 of 2 is wrong.*`openvima data"):
        damaged[1]


def test_a_prompt_is_split_into_texts_and_images() -> None:
    text = "Put {a} into {b}, then {a} back."
    assert image_names(text) == ("a", "b")
    assert split_prompt(text) == ("Put", 0, "into", 1, ", then", 0, "back.")
    assert split_prompt("{x}") == (0,)
    assert split_prompt("only words") == ("only words",)


def test_no_cache_is_made_of_damaged_demonstrations(copy: Path) -> None:
    flip_bit(copy / "rotate-train-00001.arrow")
    with pytest.raises(DatasetError, match=r"rotate-train-00001\.arrow: record .*\(its checksum is wrong\)"):
        open_object_cache(Dataset(copy))
    with pytest.raises(DatasetError, match="lacks"):
        ObjectCache(Dataset(copy))


def test_makers_of_the_same_cache_leave_each_other_alone(copy: Path) -> None:
    folder = copy / "object_cache" / "objects-v1"
    folder.mkdir(parents=True)
    writing = folder / f".rotate-train-00000.arrow.{os.getppid()}.tmp"
    writing.touch()
    open_object_cache(Dataset(copy))
    assert writing.exists()
