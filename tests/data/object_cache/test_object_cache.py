"""The object cache: equal to preprocessing anew, written once, never trusted when damaged or old."""

import json
import os
import pickle
from collections import Counter
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest
from xxhash import xxh3_64_intdigest

from damage_cache import damage_files
from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.object_cache import cache_file
from openvima.data.object_cache.cache import ObjectCache, open_object_cache
from openvima.data.object_cache.cache_file import INDEX, OBJECT, PREAMBLE, CacheFile
from openvima.data.object_cache.episode import preprocess
from openvima.data.object_cache.episode_batch import EpisodeBatch
from openvima.errors import DatasetError, ShardError
from openvima.perception.preprocessing import KINDS, image_names, split_prompt

TASKS = ("rotate", "rearrange_then_restore")


def assert_equal(a: object, b: object) -> None:
    for field in fields(a):
        ours, theirs = getattr(a, field.name), getattr(b, field.name)
        if isinstance(theirs, list) and isinstance(theirs[0], np.ndarray):  # the images of a batch
            assert all(np.array_equal(*pair) for pair in zip(ours, theirs, strict=True))
        elif is_dataclass(ours):
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


@pytest.mark.parametrize("kind", KINDS)
def test_episodes_read_together_equal_those_read_one_by_one(demos: Path, kind) -> None:
    cache = open_object_cache(Dataset(demos), kind)
    rows = [7, 2, 2, 9]
    together = cache.batch(rows)
    assert_equal(together, EpisodeBatch.of([cache[row] for row in rows]))
    counts = [len(cache[row].images) for row in rows]
    assert together.image_offsets.tolist() == [0, *np.cumsum(counts)[:-1]]


def test_several_workers_make_the_same_files(copy: Path, tmp_path: Path) -> None:
    one = open_object_cache(Dataset(copy), folder=tmp_path / "one").folder
    two = open_object_cache(Dataset(copy), folder=tmp_path / "two", workers=2).folder
    files = sorted(path.name for path in one.iterdir())
    assert files == sorted(path.with_suffix(".cache").name for path in copy.glob("*.arrow"))
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
    open_object_cache(Dataset(copy))
    for path in copy.glob("*.arrow"):
        path.unlink()
    generate(GenerateConfig(out=copy, tasks=TASKS, episodes=5, shard_size=2, start_seed=50, force=True))
    with pytest.raises(DatasetError, match="lacks 6 shards"):
        ObjectCache(Dataset(copy))
    assert open_object_cache(Dataset(copy))[0].seed == Dataset(copy)[0].seed


@pytest.mark.parametrize("size", [0, 7, 1000, -1])
def test_a_truncated_file_is_made_anew(copy: Path, size: int) -> None:
    cache = open_object_cache(Dataset(copy))
    path = next(iter(sorted(cache.folder.iterdir())))
    whole = path.read_bytes()
    path.write_bytes(whole[:size])
    with pytest.raises(ShardError, match="is no readable file"):
        CacheFile(path)
    with pytest.raises(DatasetError, match="lacks 1 shards"):
        ObjectCache(Dataset(copy))
    open_object_cache(Dataset(copy))
    assert path.read_bytes() == whole


def test_a_shard_of_demonstrations_is_no_cache_file(copy: Path) -> None:
    with pytest.raises(ShardError, match="is no readable file"):
        CacheFile(next(copy.glob("*.arrow")))
    with pytest.raises(ShardError, match="is no readable file"):
        CacheFile(copy / "gone.arrow")


def test_a_folder_that_cannot_be_made_is_named(copy: Path) -> None:
    (copy / "blocked").write_text("a file")
    with pytest.raises(DatasetError, match=r"cannot write the object cache to .*blocked"):
        open_object_cache(Dataset(copy), folder=copy / "blocked")
    with pytest.raises(DatasetError, match="Did you mean 'frames'"):
        open_object_cache(Dataset(copy), "frame")  # type: ignore[arg-type]


def test_a_cache_can_be_sent_to_another_process(demos: Path) -> None:
    cache = open_object_cache(Dataset(demos, tasks=["rotate"]))
    _ = cache[0]
    again = pickle.loads(pickle.dumps(cache))
    assert_equal(again[3], cache[3])
    assert [episode.seed for episode in again[1:3]] == [cache[1].seed, cache[2].seed]


def test_damage_is_found_or_harmless(copy: Path) -> None:
    dataset = Dataset(copy, tasks=["rotate"])
    paths = [path for kind in KINDS for path in sorted(open_object_cache(dataset, kind).folder.iterdir())]
    outcomes = damage_files(paths, rounds=300, seed=0)
    assert sum(outcomes.values(), Counter()).keys() <= {"found", "harmless"}, outcomes


def test_a_damaged_record_is_named_where_others_are_read(copy: Path) -> None:
    cache = open_object_cache(Dataset(copy, tasks=["rotate"]))
    path = cache.folder / "rotate-train-00000.cache"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.unlink()  # the cache has the old file mapped
    path.write_bytes(content)
    damaged = ObjectCache(Dataset(copy, tasks=["rotate"]))
    assert_equal(damaged[0], cache[0])
    with pytest.raises(ShardError, match=r"00000\.cache .* record 1 of 2 is wrong.*`openvima data"):
        damaged[1]
    episodes = damaged.batch([0, 1])  # its tables are whole
    with pytest.raises(ShardError, match="record 1 of 2 is wrong"):
        list(episodes.images)


@pytest.mark.parametrize("counts", ["inputs", "fewer", "more"])
def test_the_first_images_are_read_straight_into_a_stack(demos: Path, counts) -> None:
    cache = open_object_cache(Dataset(demos))
    rows = [7, 2, 9]
    episodes = cache.batch(rows)
    tables = [(cache[row].prompt.objects, cache[row].objects) for row in rows]
    inputs = [max(int(table.crop_index.max()) for table in both) for both in tables]
    asked = [count + {"inputs": 0, "fewer": -1, "more": 1}[counts] for count in inputs]
    stack = np.zeros((2 + sum(asked), *episodes.images.shape), np.uint8)
    episodes.images.read_first(asked, (2 + np.cumsum(asked) - asked).tolist(), stack)
    expected = [cache[row].images[:count] for row, count in zip(rows, asked, strict=True)]
    assert np.array_equal(stack, np.concatenate([np.zeros_like(stack[:2]), *expected]))


@pytest.mark.parametrize("part", ["tables", "images"])
def test_a_batch_with_a_damaged_record_is_refused(copy: Path, part) -> None:
    cache = open_object_cache(Dataset(copy, tasks=["rotate"]))
    path = cache.folder / "rotate-train-00000.cache"
    entry = CacheFile(path).index[1]
    content = bytearray(path.read_bytes())
    content[entry["start" if part == "tables" else "images_start"]] ^= 1
    path.unlink()
    path.write_bytes(content)
    damaged = ObjectCache(Dataset(copy, tasks=["rotate"]))
    with pytest.raises(ShardError, match=r"00000\.cache .* record 1 of 2 is wrong"):
        episodes = damaged.batch([0, 1])
        counts = episodes.images.entries["num_inputs"].tolist()
        stack = np.zeros((sum(counts), 3, 32, 32), np.uint8)
        episodes.images.read_first(counts, (np.cumsum(counts) - counts).tolist(), stack)


@pytest.mark.parametrize(
    ("head", "reason"),
    [
        ({"version": 6, "kind": "objects"}, "its head lacks descriptions, rows, source, tasks, variant"),
        ({"version": 6, "kind": ["objects"]}, "its kind is"),
        ({}, "it is of version None, not 6"),
        ([], "no attribute 'get'"),
        (
            {"version": 6, "kind": "objects", "source": 1, "variant": "", "tasks": [], "descriptions": []}
            | {"rows": 0},
            "other values than texts",
        ),
    ],
)
def test_a_foreign_head_is_no_cache_file(tmp_path: Path, head: object, reason: str) -> None:
    content = json.dumps(head).encode()
    end = PREAMBLE.itemsize + len(content)
    preamble = np.array((b"ovcache\n", 0, end, len(content)), PREAMBLE)
    preamble["checksum"] = xxh3_64_intdigest(preamble.tobytes()[16:] + content)
    path = tmp_path / "foreign.cache"
    path.write_bytes(preamble.tobytes() + content)
    with pytest.raises(ShardError, match=rf"no readable file of the object cache \(.*{reason}"):
        CacheFile(path)


@pytest.mark.parametrize(("field", "value"), [("num_steps", 10_000), ("start", -64), ("task", 2)])
def test_counts_beyond_a_record_are_found_when_a_file_is_opened(copy: Path, field: str, value: int) -> None:
    path = next(iter(sorted(open_object_cache(Dataset(copy)).folder.iterdir())))
    content = bytearray(path.read_bytes())
    preamble = np.frombuffer(content, PREAMBLE, count=1)
    start = PREAMBLE.itemsize + int(preamble["json_bytes"][0])
    np.frombuffer(content, INDEX, count=1, offset=start)[field] = value
    preamble["checksum"] = xxh3_64_intdigest(content[16 : int(preamble["head_bytes"][0])])
    path.write_bytes(content)
    with pytest.raises(ShardError, match="counts more than its records hold"):
        CacheFile(path)


def test_a_description_that_is_not_there_is_damage(demos: Path) -> None:
    file = CacheFile(open_object_cache(Dataset(demos)).folder / "rotate-train-00000.cache")
    count = len(file.descriptions)
    assert file._descriptions_of(0, "Put {a} on {b}.", [0, count - 1]) == {"b": file.descriptions[-1]}
    with pytest.raises(ShardError, match="counts more descriptions"):
        file._descriptions_of(0, "Put {a} on {b}.", [0, count])


def test_files_of_another_version_are_named_and_made_anew(copy: Path, monkeypatch) -> None:
    monkeypatch.setattr(cache_file, "CACHE_VERSION", 3)
    path = next(open_object_cache(Dataset(copy)).folder.iterdir())
    monkeypatch.undo()
    with pytest.raises(ShardError, match=r"of version 3, not 6\)\. .*`openvima data preprocess` makes it"):
        CacheFile(path)
    with pytest.raises(DatasetError, match=r"lacks 6 shards, .*`openvima data preprocess .*` writes them"):
        ObjectCache(Dataset(copy))


def test_a_file_is_read_as_documented(demos: Path) -> None:
    cache = open_object_cache(Dataset(demos, tasks=["rotate"]))
    content = (cache.folder / "rotate-train-00000.cache").read_bytes()
    preamble = np.frombuffer(content, PREAMBLE, count=1)[0]
    index_start = PREAMBLE.itemsize + int(preamble["json_bytes"])
    about = json.loads(content[PREAMBLE.itemsize : index_start])
    assert about["tasks"] == ["rotate"]
    entry = np.frombuffer(content, INDEX, count=about["rows"], offset=index_start)[1]
    objects_start = entry["start"] + entry["num_prompt_objects"] * OBJECT.itemsize
    objects = np.frombuffer(content, OBJECT, count=entry["num_objects"], offset=objects_start)
    for name in OBJECT.names:
        assert np.array_equal(objects[name], getattr(cache[1].objects, name))
    end = entry["images_start"] + entry["num_images"] * 3 * 32 * 32
    images = np.frombuffer(content[entry["images_start"] : end], np.uint8).reshape(-1, 3, 32, 32)
    assert np.array_equal(images, cache[1].images)
    assert xxh3_64_intdigest(content[entry["start"] : entry["images_start"]]) == entry["tables_checksum"]
    others = entry["images_start"] + entry["num_inputs"] * 3 * 32 * 32
    assert xxh3_64_intdigest(content[entry["images_start"] : others]) == entry["inputs_checksum"]
    assert xxh3_64_intdigest(content[others:end]) == entry["others_checksum"]


def test_a_prompt_is_split_into_texts_and_images() -> None:
    text = "Put {a} into {b}, then {a} back."
    assert image_names(text) == ("a", "b")
    assert split_prompt(text) == ("Put", 0, "into", 1, ", then", 0, "back.")
    assert split_prompt("{x}") == (0,)
    assert split_prompt("only words") == ("only words",)


def test_no_cache_is_made_of_damaged_demonstrations(copy: Path) -> None:
    shard = copy / "rotate-train-00001.arrow"
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    with pytest.raises(ShardError, match=r"rotate-train-00001\.arrow: record .*\(its checksum is wrong\)"):
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
