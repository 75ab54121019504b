"""The object cache of a detector: its records, its folder, and that it is written once."""

import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from openvima.cli.main import main
from openvima.data import Dataset
from openvima.data.manifest import joint_hash
from openvima.data.object_cache import (
    Boxes,
    ObjectCache,
    open_object_cache,
    write_cache_file,
)
from openvima.data.preprocessed import preprocess
from openvima.errors import DatasetError, WorkerError
from openvima.perception.boxes import object_iou
from openvima.perception.objects import GROUND_TRUTH, observe
from plugged_extractors import HOOK, NoisyExtractor
from small_data_sets import rows_of

CLUMSY = Boxes("clumsy-1", NoisyExtractor)


def test_ids_are_places_and_the_objects_to_move_are_named_by_them(demos: Path) -> None:
    num_lost = 0
    for demo in Dataset(demos):
        episode = preprocess(demo, "objects", NoisyExtractor())
        assert episode.prompt.text == demo.prompt.text
        for t, table in enumerate(episode.objects.split(episode.objects_per_step)):
            found, true = NoisyExtractor().in_observation(demo.observation(t)), observe(demo.observation(t))
            assert table.ids.tolist() == list(range(len(found)))
            shares = object_iou(found, true)
            for slots, asked in (
                (episode.pick_ids, demo.pick_ids[t]),
                (episode.place_ids, demo.place_ids[t]),
            ):
                slot, there = (
                    slots[t],
                    true.ids.tolist().index(asked) if asked in true.ids else -1,
                )
                if slot >= 0:
                    assert shares[slot, there] >= 0.5
                    assert shares[slot].argmax() == there
                elif there >= 0:
                    num_lost += 1
                    assert not (shares[:, there] >= 0.5).any()
    assert num_lost  # some are not found


def test_a_extractor_that_is_always_right_names_the_same_objects(demos: Path) -> None:
    for demo in Dataset(demos):
        detected, true = (preprocess(demo, "objects", extractor) for extractor in (GROUND_TRUTH, None))
        for name in ("images", "actions"):
            np.testing.assert_array_equal(getattr(detected, name), getattr(true, name))
        ours, theirs = detected.prompt.objects_per_image, true.prompt.objects_per_image
        np.testing.assert_array_equal(ours, theirs)
        for name in ("crop_index", "boxes", "grasps"):
            np.testing.assert_array_equal(getattr(detected.objects, name), getattr(true.objects, name))
        starts = np.cumsum(true.objects_per_step) - true.objects_per_step
        for name in ("pick_ids", "place_ids"):
            slots, ids = getattr(detected, name), getattr(true, name)
            assert ((slots >= 0) == (ids >= 0)).all()
            named = true.objects.ids[(starts + slots)[slots >= 0]]
            np.testing.assert_array_equal(named, ids[slots >= 0])


def test_every_detector_has_a_folder_of_its_own_which_is_made_once(copy: Path) -> None:
    dataset, made = Dataset(copy), []

    def make(pixels: int) -> NoisyExtractor:
        made.append(pixels)
        return NoisyExtractor(pixels)

    one, two = Boxes("clumsy-1", partial(make, 1)), Boxes("clumsy-2", partial(make, 2))
    caches = [open_object_cache(dataset, boxes=boxes) for boxes in (None, one, two)]
    assert [cache.folder.name for cache in caches] == [
        "objects-v7",
        "objects-v7-clumsy-1",
        "objects-v7-clumsy-2",
    ]
    assert made == [1, 2]  # once, for all shards
    reopened = open_object_cache(dataset, boxes=two)
    assert rows_of(reopened[0].objects).tolist() == rows_of(caches[2][0].objects).tolist()
    assert made == [1, 2]
    assert rows_of(caches[1][0].objects).tolist() != rows_of(caches[2][0].objects).tolist()
    again = pickle.loads(pickle.dumps(caches[2]))
    assert rows_of(again[3].objects).tolist() == rows_of(caches[2][3].objects).tolist()
    with pytest.raises(DatasetError, match="lacks 6 shards"):
        ObjectCache(dataset, variant="clumsy-3")


def test_an_interrupted_maker_goes_on_shard_by_shard(copy: Path) -> None:
    dataset, seen = Dataset(copy), []

    class Tiring(NoisyExtractor):
        def in_observation(self, observation):
            if len(seen) == 12:
                raise WorkerError("enough")
            seen.append(observation)
            return super().in_observation(observation)

    with pytest.raises(WorkerError, match="enough"):
        open_object_cache(dataset, boxes=Boxes("clumsy-1", Tiring))
    folder = copy / "object_cache" / "objects-v7-clumsy-1"
    before = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.arrow")}
    assert 1 <= len(before) <= 5
    cache = open_object_cache(dataset, boxes=CLUMSY)
    assert all((folder / name).stat().st_mtime_ns == time for name, time in before.items())
    for demo, episode in zip(dataset, cache, strict=True):
        expected = preprocess(demo, "objects", NoisyExtractor())
        assert rows_of(episode.objects).tolist() == rows_of(expected.objects).tolist()


def test_a_cache_may_hold_a_fraction_of_the_demonstrations(copy: Path) -> None:
    dataset = Dataset(copy)
    whole, part = (open_object_cache(dataset, boxes=replace(CLUMSY, fraction=f)) for f in (1.0, 0.5))
    assert part.folder.name == "objects-v7-clumsy-1-0.5"
    held = np.flatnonzero(part.lengths()[:, 0])
    assert 0 < len(held) < len(dataset)
    assert held.tolist() == np.flatnonzero(part.image_counts()).tolist()
    for row, (episode, expected) in enumerate(zip(part, whole, strict=True)):
        assert (episode.task, episode.seed) == (expected.task, expected.seed)
        if row in held:
            np.testing.assert_array_equal(episode.images, expected.images)
            assert rows_of(episode.objects).tolist() == rows_of(expected.objects).tolist()
        else:
            assert not episode.num_steps and not len(episode.images)
    tasks = Dataset(copy, tasks=["rotate"])  # the same ones, whatever else is there
    others = open_object_cache(tasks, folder=copy / "other", boxes=replace(CLUMSY, fraction=0.5))
    names = {(e.task, e.seed) for e in others if e.num_steps}
    assert names == {(e.task, e.seed) for e in part if e.num_steps and e.task == "rotate"}


def test_files_of_another_detector_in_the_folder_are_not_trusted(copy: Path) -> None:
    dataset = Dataset(copy, tasks=["rotate"])
    cache = open_object_cache(dataset, boxes=CLUMSY)
    path = cache.folder / "rotate-train-00000.arrow"
    whole = path.read_bytes()
    source = joint_hash(dataset.index.slice(0, 2))
    write_cache_file(path, [cache[0], cache[1]], "objects", source, "clumsy-2")
    with pytest.raises(DatasetError, match="lacks 1 shards"):
        ObjectCache(dataset, variant="clumsy-1")
    open_object_cache(dataset, boxes=CLUMSY)
    assert path.read_bytes() == whole


def test_the_verb_makes_what_training_would(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["data", "preprocess", str(copy), "--boxes", HOOK]
    assert main(words) == 0
    (folder,) = (copy / "object_cache").iterdir()
    assert capsys.readouterr().out.strip() == str(folder)
    assert len(ObjectCache(Dataset(copy), variant=folder.name.removeprefix("objects-v7-"))) == 10
    assert main([*words, "--kind", "frames"]) == 2
    assert "whole frames have none" in capsys.readouterr().err
