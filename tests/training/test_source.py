"""Demonstrations before a training: opened, checked and split; and false positives in their batches."""

from collections import Counter
from functools import partial
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
import torch

from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.object_cache import open_object_cache
from openvima.data.subsets import MergeConfig, merge
from openvima.errors import ConfigError, DatasetError
from openvima.perception.objects import TOP, observe
from openvima.policies.loading import held_out_data
from openvima.policies.processor import Processor
from openvima.tasks.registry import held_out_tasks, list_tasks
from openvima.training import TrainingConfig
from openvima.training.augmentation.demonstrations import add_false_positives
from openvima.training.batches import BatchOrder, ExampleSource
from openvima.training.building import (
    resolve,
    training_texts,
)
from openvima.training.config import AugmentationConfig, LoaderConfig
from openvima.training.parallel import ONE_PROCESS, Parallel
from openvima.training.policy import scene_tasks
from openvima.training.run_folder import held_out_demonstrations
from openvima.training.source import (
    find_definers,
    make_order,
    open_demonstrations,
    repeat_tasks,
    split_examples,
)
from small_networks import collate_examples, examples_of, rngs_of

OBJECTS, VIEWS = Processor("objects"), Processor("views")


@pytest.fixture(scope="module")
def examples(data):
    return examples_of(Dataset(data), OBJECTS)[0]


def test_slots_point_at_the_objects_that_were_picked(data, examples):
    batch = collate_examples(OBJECTS, examples)
    for b, demo in enumerate(Dataset(data)):
        for t, action in enumerate(demo.actions):
            slot = batch.targets.pick_BT[b, t]
            seen = observe(demo.observation(t))
            assert seen.ids[slot] == demo.pick_ids[t]
            position = batch.history.positions_BTN2[b, t, slot].numpy()
            assert np.linalg.norm(position - np.array(action.pose0_position)) < 0.06


def names_of(source: ExampleSource) -> set[tuple[str, int]]:
    return {(example.episode.task, example.episode.seed) for example in source}


def test_demonstrations_of_some_tasks_are_left_out(data):
    kept = open_demonstrations(data, LoaderConfig(exclude_tasks="follow_motion, rotate"))
    assert set(kept.index.column("task").to_pylist()) == {"sweep_without_exceeding", "visual_manipulation"}
    assert not any("degrees" in text for text in training_texts(kept, AugmentationConfig()))
    assert any("degrees" in text for text in training_texts(open_demonstrations(data), AugmentationConfig()))
    with pytest.raises(
        ConfigError, match="has no other task, only rotate, sweep_without_exceeding, visual_m"
    ):
        open_demonstrations(
            data, LoaderConfig(exclude_tasks="rotate,sweep_without_exceeding,visual_manipulation")
        )


@pytest.mark.parametrize(
    ("setting", "value"), [("exclude", "rotat"), ("first", "rotat"), ("repeat", "rotat=2")]
)
def test_names_of_tasks_are_checked_when_demonstrations_are_opened(data, setting, value):
    with pytest.raises(
        ConfigError, match=rf"{setting}_tasks: there is no task 'rotat'. Did you mean 'rotate'\?"
    ):
        open_demonstrations(data, LoaderConfig(**{f"{setting}_tasks": value}))


def test_demonstrations_of_evaluation_levels_are_refused_also_in_merged_folders(data, tmp_path):
    config = GenerateConfig(tmp_path / "L4", ("heldout",), 1, level="L4", images=False)
    generate(config)
    both = merge(MergeConfig((data, tmp_path / "L4"), tmp_path / "both"))
    with pytest.raises(
        DatasetError, match=r"follow_motion L4, .*, sweep_without_touching L4. .*allow-heldout"
    ):
        open_demonstrations(both)
    assert len(held_out_demonstrations(open_demonstrations(both, allow_heldout=True))) == 4
    assert len(open_demonstrations(both, LoaderConfig(exclude_tasks=",".join(held_out_tasks())))) == 24
    assert held_out_demonstrations(Dataset(data)) == []
    # Contrastive scenes are of the training partition, whatever the demonstrations are.
    trained = [task for task in list_tasks() if task not in held_out_tasks()]
    assert scene_tasks(Dataset(tmp_path / "L4")) == trained
    assert scene_tasks(Dataset(both)) == scene_tasks(Dataset(data))


def test_a_run_says_which_held_out_demonstrations_it_saw(tmp_path):
    (tmp_path / "config.yaml").write_text(
        'demonstrations: {held_out: [twist L3, 5, "a\\e[2J"]}\ntraining: {}\n'
    )
    assert held_out_data(tmp_path) == ["twist L3", "a\N{REPLACEMENT CHARACTER}[2J"]
    assert held_out_data(tmp_path / "none") == []


def test_excluded_tasks_identify_a_run_in_any_order(settings):
    configs = [
        TrainingConfig.of({**settings, "loader.exclude_tasks": names})
        for names in ("rotate, follow_motion", "follow_motion,rotate,", "rotate")
    ]
    first, second, third = (resolve(config).identity() for config in configs)
    assert first == second != third
    assert first["loader"]["exclude_tasks"] == "follow_motion,rotate"


def test_the_split_follows_from_the_episode_and_keeps_everything(data):
    cache = open_object_cache(Dataset(data))
    training, kept = split_examples(cache, LoaderConfig(validation_fraction=0.3, validation_episodes=100))
    assert names_of(training).isdisjoint(names_of(kept))
    assert len(names_of(training) | names_of(kept)) == 24
    assert 1 <= len(kept) <= 14
    of_one_task = open_object_cache(Dataset(data, tasks=["rotate"]))
    _, fewer = split_examples(of_one_task, LoaderConfig(validation_fraction=0.3, validation_episodes=100))
    assert names_of(fewer) <= names_of(kept)
    _, least = split_examples(cache, LoaderConfig(validation_fraction=0.3, validation_episodes=1))
    assert len(least) == 1
    assert names_of(least) <= names_of(kept)
    with pytest.raises(DatasetError, match="no demonstration to train on"):
        split_examples(cache, LoaderConfig(validation_fraction=1.0, validation_episodes=1))


def test_demonstrations_of_repeated_tasks_are_shown_as_often_as_asked_in_an_epoch(data, settings):
    cache = open_object_cache(Dataset(data))
    training, _ = split_examples(cache, LoaderConfig(validation_fraction=0.3, validation_episodes=100))
    repeats = TrainingConfig.of({**settings, "loader.repeat_tasks": "rotate=3, "}).loader.repeats
    order = make_order(repeat_tasks(training, repeats), LoaderConfig(batch_size=1), 0, ONE_PROCESS)
    source = repeat_tasks(training, repeats)
    shown = Counter(source[int(order.rows(n)[0])].row for n in range(order.batches_per_epoch))
    assert shown == {e.row: 3 if e.episode.task == "rotate" else 1 for e in training}
    assert 3 in shown.values() and 1 in shown.values()
    with pytest.raises(ConfigError, match="repeat_tasks has 'rotate=0'"):
        resolve(TrainingConfig.of({**settings, "loader.repeat_tasks": "rotate=0"}))


def test_the_first_steps_show_some_tasks_alone_and_all_of_their_demonstrations(data):
    cache = open_object_cache(Dataset(data))
    training, _ = split_examples(cache, LoaderConfig(validation_fraction=0.3, validation_episodes=100))
    source = repeat_tasks(training, {"rotate": 3})

    def order_of(*tasks: str, steps: int) -> BatchOrder:
        loader = LoaderConfig(batch_size=2, first_tasks=",".join(tasks), first_steps=steps)
        return make_order(source, loader, 0, ONE_PROCESS)

    plain = order_of(steps=0)
    order = order_of("rotate", steps=plain.batches_per_epoch)
    shown = {source[row].row for n in range(order.first_batches) for row in order.rows(n)}
    assert shown == {example.row for example in training if example.episode.task == "rotate"}
    assert all((order.rows(n) == plain.rows(n)).all() for n in range(order.first_batches, 60))
    assert not order_of("twist", steps=5).first_batches  # there are none of these
    everything = [*{example.episode.task for example in training}, "twist"]
    assert not order_of(*everything, steps=5).first_batches


def test_demonstrations_whose_prompts_define_words_are_found_once():
    index = pa.table({"task": ["rotate", "novel_noun", "twist", "novel_adj"]})
    cache = SimpleNamespace(dataset=SimpleNamespace(index=index))
    nothing = np.zeros(0, np.int64)
    assert find_definers(ExampleSource(cache, np.array([0, 1, 2, 3, 3]), nothing, nothing)) == [1, 3]
    assert find_definers(ExampleSource(cache, np.array([0, 2]), nothing, nothing)) == []


def test_a_batch_is_no_larger_than_the_demonstrations_and_needs_one_for_each_process(data):
    cache = open_object_cache(Dataset(data))
    _, few = split_examples(cache, LoaderConfig(validation_fraction=0.3, validation_episodes=3))
    cpu = torch.device("cpu")
    orders = [make_order(few, LoaderConfig(), 0, Parallel(rank, 2, cpu)) for rank in range(2)]
    assert [order.batch_size for order in orders] == [2, 2]
    with pytest.raises(ConfigError, match="there are 3 demonstrations to train on and 4 processes"):
        make_order(few, LoaderConfig(), 0, Parallel(0, 4, cpu))


@pytest.mark.parametrize("layout", ["objects", "views"])
def test_augmentation_of_an_example_does_not_depend_on_its_batch(layout, demonstrations_of_several_steps):
    processor = Processor(layout)
    examples, _ = examples_of(demonstrations_of_several_steps, processor)
    collate, rngs = partial(collate_examples, processor), rngs_of(examples)
    together = add_false_positives(collate(examples), layout, probability=0.5, rngs=rngs)
    for b, example in enumerate(examples):
        alone = add_false_positives(
            collate([example]), layout, probability=0.5, rngs=rngs_of(examples)[b : b + 1]
        )
        for t in range(example.episode.num_steps):
            for v in range(2):
                assert shown(together.history, b, t, v) == shown(alone.history, 0, t, v)
        pick = together.targets.pick_BT[b, : example.episode.num_steps]
        assert torch.equal(pick, alone.targets.pick_BT[0])


def test_targets_follow_their_objects_through_shuffling(examples):
    batch = collate_examples(OBJECTS, examples)
    changed = add_false_positives(batch, "objects", probability=0.5, rngs=rngs_of(examples))
    for b, t in np.argwhere(batch.targets.steps_BT.numpy()):
        for targets in ("pick_BT", "place_BT"):
            old, new = getattr(batch.targets, targets)[b, t], getattr(changed.targets, targets)[b, t]
            assert torch.equal(
                batch.history.positions_BTN2[b, t, old], changed.history.positions_BTN2[b, t, new]
            )
            assert torch.equal(
                batch.history.crop_index_BTVN[b, t, :, old], changed.history.crop_index_BTVN[b, t, :, new]
            )
    added = changed.history.masks_BTVN.sum() - batch.history.masks_BTVN.sum()
    possible = 2 * int(batch.targets.steps_BT.sum())
    assert 0.3 * possible < added < 0.7 * possible


@pytest.fixture(scope="module")
def views(demonstrations_of_several_steps):
    """With a token for each view, as the published VIMA has it."""
    return examples_of(demonstrations_of_several_steps, VIEWS)


def shown(history, b: int, t: int, v: int) -> list[tuple[int, ...]]:
    """Number and box of all that one view shows, in order."""
    visible = history.masks_BTVN[b, t, v]
    numbers, boxes = history.crop_index_BTVN[b, t, v, visible], history.boxes_BTVN4[b, t, v, visible]
    return [(int(number), *box.tolist()) for number, box in zip(numbers, boxes, strict=True)]


def test_false_positives_come_anywhere_among_the_ordered_objects_of_a_view(views):
    batch = collate_examples(VIEWS, views[0])
    changed = add_false_positives(batch, "views", probability=0.5, rngs=rngs_of(views[0], 1))
    before, after = batch.history, changed.history
    places = []
    for b, t, v in np.ndindex(*before.masks_BTVN.shape[:3]):
        old, new = shown(before, b, t, v), shown(after, b, t, v)
        assert [slot for slot in new if slot in old] == old
        added = [slot for slot in new if slot not in old]
        false = (
            int(batch.false_positives.crop_index[b, t, v]),
            *batch.false_positives.boxes[b, t, v].tolist(),
        )
        assert added in ([], [false])
        assert not added or before.steps_BT[b, t]
        if v == TOP:  # points in which objects are picked go with them
            points = [each.grasps_BTN2[b, t, each.masks_BTVN[b, t, v]].tolist() for each in (before, after)]
            kept = [point for slot, point in zip(new, points[1], strict=True) if slot in old]
            assert kept == points[0]
        places += [(new.index(slot), len(old)) for slot in added]
    assert 0.3 < len(places) / (2 * int(before.steps_BT.sum())) < 0.7
    assert {place == 0 for place, _ in places} == {True, False}
    assert {place == count for place, count in places} == {True, False}
    assert changed.targets is batch.targets
