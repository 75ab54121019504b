"""Examples, their order, and what augmentation does to them."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from openvima.data import Dataset  # noqa: E402
from openvima.errors import DatasetError  # noqa: E402
from openvima.policies.inputs import Reader  # noqa: E402
from openvima.training.augment import augmented  # noqa: E402
from openvima.training.dataset import (  # noqa: E402
    groups_of_equal_length,
    make_batch,
    read_examples,
    rows_of_step,
)


@pytest.fixture(scope="module")
def examples(data):
    return read_examples(Dataset(data), Reader("objects"), validation_share=0.0, seed=0)


def test_slots_point_at_the_objects_that_were_picked(data, examples):
    for demo, example in zip(Dataset(data), examples.training, strict=True):
        for t, step in enumerate(example.steps):
            assert step.objects.ids[example.pick_slots[t]] == demo.pick_ids[t]
            pick = np.array(demo.actions[t].pose0_position)
            assert np.linalg.norm(step.positions[example.pick_slots[t]] - pick) < 0.06


def test_the_split_follows_from_the_episode_and_keeps_everything(data):
    split = read_examples(Dataset(data), Reader("objects"), validation_share=0.3, seed=0)
    names = [{(e.task, e.seed) for e in part} for part in (split.training, split.validation)]
    assert names[0].isdisjoint(names[1])
    assert len(names[0] | names[1]) == 24
    assert 1 <= len(names[1]) <= 14
    fewer = read_examples(list(Dataset(data))[:10], Reader("objects"), validation_share=0.3, seed=0)
    assert {(e.task, e.seed) for e in fewer.validation} <= names[1]


def test_no_demonstration_is_an_error():
    with pytest.raises(DatasetError, match="no demonstration to learn from"):
        read_examples([], Reader("objects"), validation_share=0.1, seed=0)


def test_every_epoch_shows_each_example_once():
    rows = np.concatenate([rows_of_step(10, batch=4, step=step, seed=1) for step in range(5)])
    assert sorted(rows[:10]) == list(range(10))
    assert sorted(rows[10:]) == list(range(10))
    assert rows[:10].tolist() != rows[10:].tolist()
    np.testing.assert_array_equal(rows[8:12], rows_of_step(10, batch=4, step=2, seed=1))


def test_groups_hold_all_examples_of_like_length(examples):
    groups = groups_of_equal_length(examples.training)
    assert sum(len(group) for group in groups) == 24
    assert {len(e.steps) for e in groups[0]} == {1}


def test_targets_follow_their_objects_through_shuffling(examples):
    batch = make_batch(examples.training)
    generator = torch.Generator().manual_seed(0)
    changed = augmented(batch, probability=0.5, generator=generator)
    for b, t in np.argwhere(batch.targets.steps_BT.numpy()):
        for targets in ("pick_BT", "place_BT"):
            old, new = getattr(batch.targets, targets)[b, t], getattr(changed.targets, targets)[b, t]
            assert torch.equal(
                batch.history.positions_BTN2[b, t, old], changed.history.positions_BTN2[b, t, new]
            )
            assert torch.equal(
                batch.history.crops_BTVN[b, t, :, old], changed.history.crops_BTVN[b, t, :, new]
            )
    added = changed.history.masks_BTVN.sum() - batch.history.masks_BTVN.sum()
    possible = 2 * int(batch.targets.steps_BT.sum())
    assert 0.3 * possible < added < 0.7 * possible


def test_a_false_detection_shows_in_one_view_only(examples):
    batch = make_batch(examples.training[:4])
    nothing = replace(batch.history, masks_BTVN=torch.zeros_like(batch.history.masks_BTVN))
    changed = augmented(
        replace(batch, history=nothing), probability=1.0, generator=torch.Generator().manual_seed(0)
    )
    views = changed.history.masks_BTVN.sum(dim=2)[changed.history.steps_BT]
    assert views.max() == 1
    assert (views.sum(dim=1) == 2).all()
