"""Subsets of demonstrations, and queries for them."""

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from openvima.cli.main import main
from openvima.data import Dataset, Demonstration, GenerateConfig, ShardWriter, generate
from openvima.data.encoding import ShardInfo, Skipped
from openvima.data.manifest import finish_folder
from openvima.data.reader import find_demonstrations
from openvima.data.subsets import (
    MergeConfig,
    SubsetConfig,
    assign_splits,
    merge,
    parse_splits,
    sample,
    select_sample,
    split,
)
from openvima.errors import ConfigError, DatasetError
from small_data_sets import contents, flip_bit

MadeUp = Callable[..., Demonstration]
WriteFolder = Callable[..., Path]
HALVES = {"a": 0.5, "b": 0.5}


@pytest.fixture
def write_folder(made_up: MadeUp, info: ShardInfo) -> WriteFolder:
    """A function that writes a data set of two tasks, with shards of at most four episodes."""

    def write(folder: Path, seeds: range = range(6), **settings: object) -> Path:
        folder.mkdir(parents=True)
        paths = []
        for task in ("rotate", "stack"):
            for number, start in enumerate(range(0, len(seeds), 4)):
                own = replace(info, task=task, number=number, **settings)  # type: ignore[arg-type]
                paths.append(folder / f"{task}-{own.level}-{number:05d}.arrow")
                with ShardWriter(paths[-1], own) as writer:
                    for seed in seeds[start : start + 4]:
                        demo = replace(made_up(seed, num_steps=0, num_images=0), task=task, level=own.level)
                        writer.write(demo, [Skipped(900 + seed, "failed", "it fell")])
        config = {"seeds": [seeds.start, seeds.stop]}
        finish_folder(folder, paths, command="openvima generate", config=config, versions=info.versions)
        return folder

    return write


def index_of(num_episodes: int, tasks: tuple[str, ...] = ("rotate", "stack")) -> pa.Table:
    rows = [(task, seed) for task in tasks for seed in range(num_episodes)]
    return pa.table(
        {
            "task": [task for task, _ in rows],
            "level": ["train"] * len(rows),
            "domain": ["train"] * len(rows),
            "seed": [seed for _, seed in rows],
            "content_hash": [f"{task}{seed}" for task, seed in rows],
        }
    )


def names(index: pa.Table, mask: np.ndarray) -> set[str]:
    return set(index.filter(pa.array(mask)).column("content_hash").to_pylist())


def episodes(folder: Path) -> list[tuple[str, str]]:
    index = Dataset(folder).index
    return sorted(
        zip(index.column("task").to_pylist(), index.column("content_hash").to_pylist(), strict=True)
    )


def test_smaller_samples_are_part_of_larger_ones() -> None:
    index = index_of(2000)
    chosen = [select_sample(index, 0, fraction=fraction) for fraction in (0.001, 0.01, 0.1, 1.0)]
    assert [mask.sum() for mask in chosen] == [4, 40, 400, 4000]
    for smaller, larger in itertools.pairwise(chosen):
        assert not (smaller & ~larger).any()


@pytest.mark.parametrize(
    ("asked", "counts"), [({"episodes": 10}, (10, 10, 3)), ({"fraction": 0.1}, (100, 3, 1))], ids=str
)
def test_each_task_gives_a_number_or_its_share_of_episodes_and_at_least_one(asked, counts) -> None:
    tasks = ("rotate", "stack", "twist")
    index = pa.concat_tables([index_of(n, (task,)) for n, task in zip((1000, 30, 3), tasks, strict=True)])
    mask = select_sample(index, 0, **asked)
    assert not (mask & ~select_sample(index, 0, fraction=0.99)).any()
    chosen = index.filter(pa.array(mask)).column("task").to_pylist()
    assert tuple(map(chosen.count, tasks)) == counts
    with pytest.raises(ConfigError, match="episodes is 0"):
        select_sample(index, 0, episodes=0)


def test_choices_do_not_depend_on_the_order_of_episodes_but_on_the_seed() -> None:
    index = index_of(300)
    shuffled = index.take(np.random.default_rng(0).permutation(len(index)))
    first, other = (select_sample(index, seed, fraction=0.1) for seed in (0, 1))
    assert names(index, first) == names(shuffled, select_sample(shuffled, 0, fraction=0.1))
    assert names(index, first) != names(index, other)


def test_the_episodes_of_a_sample_are_these() -> None:
    index = index_of(1000, ("rotate",))
    chosen = index.filter(pa.array(select_sample(index, 0, fraction=0.003))).column("seed").to_pylist()
    # on every machine and in every version: published results name samples by seed
    assert chosen == [90, 654, 808]


def test_parts_are_disjoint_complete_and_nearly_of_their_shares() -> None:
    index = index_of(5000)
    chosen = assign_splits(index, {"training": 0.9, "validation": 0.07, "test": 0.03}, 0)
    assert (sum(mask.astype(int) for mask in chosen.values()) == 1).all()
    fractions = [mask.mean() for mask in chosen.values()]
    assert np.allclose(fractions, (0.9, 0.07, 0.03), atol=0.01)


def test_an_episode_stays_in_its_part_when_data_are_added() -> None:
    small, large = index_of(100), index_of(1000)
    before, after = (assign_splits(index, HALVES, 0) for index in (small, large))
    for part in before:
        assert names(small, before[part]) <= names(large, after[part])


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("training=0.9,validation=0.2", "that add up to 1"),
        ("training", "give names and fractions"),
        ("training=much", "give names and fractions"),
        ("a=0.5,a=0.5", "that add up to 1"),
        ("../a=0.5,b=0.5", "give names of letters"),
        ("a=1.0", "between 0 and 1"),
        ("a=nan,b=0.5", "between 0 and 1"),
    ],
)
def test_parts_that_make_no_sense_are_refused(text: str, fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        split(SubsetConfig(Path("source"), Path("out")), parse_splits(text))


def test_a_sample_holds_the_records_unchanged_and_names_its_source_by_content(
    tmp_path: Path, write_folder: WriteFolder
) -> None:
    source = write_folder(tmp_path / "demos")
    folder = sample(SubsetConfig(source, tmp_path / "half"), 0.5)
    originals = {(demo.task, demo.seed): demo for demo in Dataset(source)}
    copies = Dataset(folder)
    assert [demo.task for demo in copies] == ["rotate"] * 3 + ["stack"] * 3
    for demo in copies:
        assert demo.content_hash() == originals[demo.task, demo.seed].content_hash()
        assert demo.versions == originals[demo.task, demo.seed].versions
    shard = copies.shard("rotate-train-00000.arrow")
    skipped = shard.table(["seed", "skipped"]).to_pylist()
    for row in skipped:
        assert row["skipped"] == [{"seed": 900 + row["seed"], "kind": "failed", "reason": "it fell"}]
    manifest, original = copies.manifest, Dataset(source).manifest
    assert manifest["command"] == "openvima data sample"
    assert manifest["config"]["fraction"] == 0.5
    assert manifest["config"]["source"]["content_hash"] == original["content_hash"]
    assert manifest["config"]["source"]["config"] == original["config"]
    assert str(tmp_path) not in json.dumps(manifest)


def test_a_split_gives_each_episode_to_one_part(tmp_path: Path, write_folder: WriteFolder) -> None:
    source = write_folder(tmp_path / "demos")
    folder = split(SubsetConfig(source, tmp_path / "parts"), HALVES)
    assert sorted(path.name for path in folder.iterdir()) == ["a", "b"]
    assert sorted(episodes(folder / "a") + episodes(folder / "b")) == episodes(source)
    by_two = split(SubsetConfig(source, tmp_path / "two", workers=2), HALVES)
    assert contents(by_two) == contents(folder)


def test_subsets_can_be_narrowed_to_tasks(tmp_path: Path, write_folder: WriteFolder) -> None:
    source = write_folder(tmp_path / "demos")
    folder = sample(SubsetConfig(source, tmp_path / "half", tasks=("stack",)), 0.5)
    whole = sample(SubsetConfig(source, tmp_path / "both"), 0.5)
    assert episodes(folder) == [entry for entry in episodes(whole) if entry[0] == "stack"]
    with pytest.raises(DatasetError, match="Did you mean 'stack'"):
        sample(SubsetConfig(source, tmp_path / "none", tasks=("stak",)), 0.5)


def test_a_merge_holds_all_episodes_in_either_order_of_the_sources(
    tmp_path: Path, write_folder: WriteFolder
) -> None:
    first, second = write_folder(tmp_path / "1"), write_folder(tmp_path / "2", range(6, 9))
    folder = merge(MergeConfig((first, second), tmp_path / "all"))
    assert episodes(folder) == sorted(episodes(first) + episodes(second))
    assert sorted(demo.seed for demo in Dataset(folder, tasks=["rotate"])) == list(range(9))
    other = merge(MergeConfig((second, first), tmp_path / "again"))
    assert contents(other) == contents(folder)


def test_a_merge_keeps_what_each_source_says_of_itself(tmp_path: Path, write_folder: WriteFolder) -> None:
    first = write_folder(tmp_path / "1", range(1))
    second = write_folder(tmp_path / "2", range(1), compat=True, versions={"openvima": "7"}, level="L1")
    folder = merge(MergeConfig((first, second), tmp_path / "all"))
    dataset = Dataset(folder)
    infos = [dataset.shard(name).info for name in dataset.shard_names()]
    assert [(info.task, info.level, info.compat) for info in infos] == [
        ("rotate", "L1", True),
        ("rotate", "train", False),
        ("stack", "L1", True),
        ("stack", "train", False),
    ]
    assert dataset[0].versions == {"openvima": "7"}


def test_episodes_that_repeat_others_are_refused_or_skipped(
    tmp_path: Path, write_folder: WriteFolder
) -> None:
    first, second = write_folder(tmp_path / "1"), write_folder(tmp_path / "2", range(4, 9))
    with pytest.raises(DatasetError, match=r"4 episodes.*rotate train train seed 4 in .*1 and .*2\."):
        merge(MergeConfig((first, second), tmp_path / "all"))
    folder = merge(MergeConfig((first, second), tmp_path / "all", duplicates="skip"))
    assert episodes(folder) == sorted(set(episodes(first) + episodes(second)))
    assert merge(MergeConfig((first, first), tmp_path / "same", duplicates="skip")).is_dir()
    assert episodes(tmp_path / "same") == episodes(first)


def test_equal_seeds_of_another_setup_are_no_duplicates(tmp_path: Path, write_folder: WriteFolder) -> None:
    first, second = write_folder(tmp_path / "1"), write_folder(tmp_path / "2", compat=True)
    assert len(Dataset(merge(MergeConfig((first, second), tmp_path / "all")))) == 24


def test_damage_of_a_source_is_noticed_and_nothing_is_left(tmp_path: Path, write_folder: WriteFolder) -> None:
    source = write_folder(tmp_path / "demos", range(3))
    flip_bit(source / "stack-train-00000.arrow")
    with pytest.raises(DatasetError, match=r"demos.stack-train-00000\.arrow"):
        merge(MergeConfig((source,), tmp_path / "out"))
    with pytest.raises(DatasetError, match=r"demos.stack-train-00000\.arrow"):
        sample(SubsetConfig(source, tmp_path / "out"), 1.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demos"]


def test_a_folder_that_would_harm_a_source_is_refused(tmp_path: Path, write_folder: WriteFolder) -> None:
    source = write_folder(tmp_path / "all" / "demos", range(1))
    before = contents(source)
    for out in (source, source.parent, source / "in"):
        fault = "holds the source .* or lies in it"
        with pytest.raises(DatasetError, match=fault):
            sample(SubsetConfig(source, out, force=True), 1.0)
        with pytest.raises(DatasetError, match=fault):
            merge(MergeConfig((source,), out, force=True))
    assert contents(source) == before


def test_only_data_sets_are_replaced_and_only_on_demand(tmp_path: Path, write_folder: WriteFolder) -> None:
    source = write_folder(tmp_path / "demos", range(2))
    out = sample(SubsetConfig(source, tmp_path / "out"), 0.5)
    before = contents(out)
    with pytest.raises(DatasetError, match="not empty"):
        sample(SubsetConfig(source, out), 1.0)
    assert contents(out) == before
    sample(SubsetConfig(source, out, force=True), 1.0)
    assert episodes(out) == episodes(source)
    home = tmp_path / "home"
    home.mkdir()
    (home / "letter.txt").write_text("dear")
    with pytest.raises(DatasetError, match="holds other things"):
        sample(SubsetConfig(source, home, force=True), 1.0)
    assert contents(home) == {"letter.txt": b"dear"}
    (out / "letter.txt").write_text("dear")
    with pytest.raises(DatasetError, match="holds other things"):
        sample(SubsetConfig(source, out, force=True), 1.0)
    assert (out / "letter.txt").exists()


def test_the_command_line_samples_splits_and_merges(
    tmp_path: Path, write_folder: WriteFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_folder(tmp_path / "demos")
    parts = tmp_path / "parts"
    assert (
        main(["data", "sample", str(source), str(tmp_path / "s"), "--fraction", ".5", "--tasks", "rotate"])
        == 0
    )
    assert main(["data", "split", str(source), str(parts), "--splits", "a=0.5,b=0.5"]) == 0
    assert main(["data", "merge", str(parts / "a"), str(parts / "b"), str(tmp_path / "m")]) == 0
    shown = [str(tmp_path / "s"), str(parts / "a"), str(parts / "b"), str(tmp_path / "m")]
    assert capsys.readouterr().out.split() == shown
    assert episodes(tmp_path / "m") == episodes(source)
    assert main(["data", "merge", str(source)]) == 2
    assert "at least two folders" in capsys.readouterr().err
    assert main(["data", "sample", str(source), str(tmp_path / "t"), "--fraction", "1.5"]) == 2
    assert "fraction is 1.5" in capsys.readouterr().err
    assert main(["data", "sample", str(source), str(tmp_path / "t"), "--fraction", "1", "--tasks", ","]) == 2
    assert capsys.readouterr().err.startswith("openvima: DatasetError: no task is named; ")
    assert main(["data", "merge", str(source), str(tmp_path / "t"), "--tasks", ","]) == 2
    assert capsys.readouterr().err.startswith(
        "openvima: DatasetError: no task is named; in the sources are rotate, stack."
    )


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    tasks = ("manipulate_old_neighbor", "visual_manipulation")
    return Dataset(generate(GenerateConfig(tmp_path_factory.mktemp("found"), tasks, episodes=5)))


def test_each_field_finds_what_a_walk_over_all_demonstrations_finds(dataset: Dataset) -> None:
    demos = list(dataset)
    shown, (first, second, *_) = demos[3].objects[0], demos[0].objects
    mixed = {"object": first.object, "texture": second.texture}  # of two objects
    cases: list[tuple[dict[str, Any], Callable[[Demonstration], bool]]] = [
        ({}, lambda d: True),
        ({"task": "visual_manipulation"}, lambda d: d.task == "visual_manipulation"),
        ({"level": "L1"}, lambda d: False),
        ({"min_steps": 2}, lambda d: d.num_steps >= 2),
        ({"max_steps": 1}, lambda d: d.num_steps <= 1),
        ({"object": shown.object}, lambda d: shown.object in {o.object for o in d.objects}),
        ({"texture": shown.texture}, lambda d: shown.texture in {o.texture for o in d.objects}),
        (
            {"object": shown.object, "texture": shown.texture},
            lambda d: (shown.object, shown.texture) in {(o.object, o.texture) for o in d.objects},
        ),
        (mixed, lambda d: (first.object, second.texture) in {(o.object, o.texture) for o in d.objects}),
    ]
    for query, fits in cases:
        expected = [index for index, demo in enumerate(demos) if fits(demo)]
        assert find_demonstrations(dataset, **query).tolist() == expected, query
    assert 0 < len(find_demonstrations(dataset, min_steps=2)) < len(demos)
    assert 0 not in find_demonstrations(dataset, **mixed)


def test_unknown_names_are_refused(dataset: Dataset) -> None:
    with pytest.raises(DatasetError, match=r"no object 'hart'\. Did you mean 'heart'\?"):
        find_demonstrations(dataset, object="hart")
    with pytest.raises(DatasetError, match=r"no task 'rotate'.* Allowed: manipulate_old_neighbor"):
        find_demonstrations(dataset, task="rotate")
