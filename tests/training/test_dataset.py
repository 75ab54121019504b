"""Examples, their order, and what augmentation does to them."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from openvima.data import Dataset  # noqa: E402
from openvima.errors import DatasetError  # noqa: E402
from openvima.perception.objects import observe  # noqa: E402
from openvima.policies.inputs import Reader  # noqa: E402
from openvima.training.augment import augmented  # noqa: E402
from openvima.training.collate import Collator  # noqa: E402
from openvima.training.dataset import (  # noqa: E402
    groups_of_equal_length,
    read_examples,
    rows_of_step,
)

OBJECTS, VIEWS = Reader("objects"), Reader("views")


@pytest.fixture(scope="module")
def examples(data):
    return read_examples(Dataset(data), Reader("objects"), validation_share=0.0)


def test_slots_point_at_the_objects_that_were_picked(data, examples):
    batch = Collator(OBJECTS)(examples.training)
    for b, demo in enumerate(Dataset(data)):
        for t, action in enumerate(demo.actions):
            slot = batch.targets.pick_BT[b, t]
            seen = observe(demo.observation(t))
            assert seen.ids[slot] == demo.pick_ids[t]
            position = batch.history.positions_BTN2[b, t, slot].numpy()
            assert np.linalg.norm(position - np.array(action.pose0_position)) < 0.06


def test_the_split_follows_from_the_episode_and_keeps_everything(data):
    split = read_examples(Dataset(data), Reader("objects"), validation_share=0.3)
    names = [{(e.tokens.task, e.tokens.seed) for e in part} for part in (split.training, split.validation)]
    assert names[0].isdisjoint(names[1])
    assert len(names[0] | names[1]) == 24
    assert 1 <= len(names[1]) <= 14
    fewer = read_examples(list(Dataset(data))[:10], Reader("objects"), validation_share=0.3)
    assert {(e.tokens.task, e.tokens.seed) for e in fewer.validation} <= names[1]


def test_no_demonstration_is_an_error():
    with pytest.raises(DatasetError, match="no demonstration to learn from"):
        read_examples([], Reader("objects"), validation_share=0.1)


def test_every_epoch_shows_each_example_once():
    rows = np.concatenate([rows_of_step(10, batch=4, step=step, seed=1) for step in range(5)])
    assert sorted(rows[:10]) == list(range(10))
    assert sorted(rows[10:]) == list(range(10))
    assert rows[:10].tolist() != rows[10:].tolist()
    np.testing.assert_array_equal(rows[8:12], rows_of_step(10, batch=4, step=2, seed=1))


def test_groups_hold_all_examples_of_like_length(examples):
    groups = groups_of_equal_length(examples.training)
    assert sum(len(group) for group in groups) == 24
    assert {e.tokens.num_steps for e in groups[0]} == {1}


def test_targets_follow_their_objects_through_shuffling(examples):
    batch = Collator(OBJECTS)(examples.training)
    generator = torch.Generator().manual_seed(0)
    changed = augmented(batch, "objects", probability=0.5, generator=generator)
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
    batch = Collator(OBJECTS)(examples.training[:4])
    nothing = replace(batch.history, masks_BTVN=torch.zeros_like(batch.history.masks_BTVN))
    changed = augmented(
        replace(batch, history=nothing),
        "objects",
        probability=1.0,
        generator=torch.Generator().manual_seed(0),
    )
    views = changed.history.masks_BTVN.sum(dim=2)[changed.history.steps_BT]
    assert views.max() == 1
    assert (views.sum(dim=1) == 2).all()


@pytest.fixture(scope="module")
def views(demonstrations_of_several_steps):
    """With a token for each view, as the published VIMA has it."""
    reader = Reader("views")
    return read_examples(demonstrations_of_several_steps, reader, validation_share=0.0)


def shown(history, b: int, t: int, v: int) -> list[tuple[int, ...]]:
    """Number and box of all that one view shows, in order."""
    visible = history.masks_BTVN[b, t, v]
    numbers, boxes = history.crops_BTVN[b, t, v, visible], history.boxes_BTVN4[b, t, v, visible]
    return [(int(number), *box.tolist()) for number, box in zip(numbers, boxes, strict=True)]


def test_false_detections_come_anywhere_among_the_objects_of_a_view_which_keep_their_order(views):
    batch = Collator(VIEWS)(views.training)
    changed = augmented(batch, "views", probability=0.5, generator=torch.Generator().manual_seed(0))
    before, after = batch.history, changed.history
    places = []
    for b, t, v in np.ndindex(*before.masks_BTVN.shape[:3]):
        old, new = shown(before, b, t, v), shown(after, b, t, v)
        assert [slot for slot in new if slot in old] == old
        added = [slot for slot in new if slot not in old]
        false = (int(batch.spurious.crops[b, t, v]), *batch.spurious.boxes[b, t, v].tolist())
        assert added in ([], [false])
        assert not added or before.steps_BT[b, t]
        places += [(new.index(slot), len(old)) for slot in added]
    assert 0.3 < len(places) / (2 * int(before.steps_BT.sum())) < 0.7
    assert {place == 0 for place, _ in places} == {True, False}
    assert {place == count for place, count in places} == {True, False}
    assert changed.targets is batch.targets


def test_slots_of_views_are_those_of_an_episode_with_such_detections(views):
    batch = Collator(VIEWS)(views.training)
    after = augmented(batch, "views", probability=0.3, generator=torch.Generator().manual_seed(1)).history
    visible_BTV = after.masks_BTVN.sum(dim=3)
    for b, t in np.argwhere(batch.history.steps_BT.numpy()):
        for v in range(2):  # visible ones first, then empty ones: black, without a box
            count = int(visible_BTV[b, t, v])
            assert after.masks_BTVN[b, t, v, :count].all()
            assert not after.crops_BTVN[b, t, v, count:].any()
            assert not after.boxes_BTVN4[b, t, v, count:].any()
        false = visible_BTV[b, : t + 1] - batch.history.masks_BTVN.sum(dim=3)[b, : t + 1]
        expected = (batch.history.counts_BT[b, : t + 1] + false.sum(dim=1)).max()
        assert after.counts_BT[b, t] == expected
    assert not after.counts_BT[~batch.history.steps_BT].any()
    assert not views.images[0].any()


def test_without_false_detections_views_stay_as_they_are(views):
    batch = Collator(VIEWS)(views.training)
    after = augmented(batch, "views", probability=0.0, generator=torch.Generator().manual_seed(0)).history
    count = batch.history.masks_BTVN.shape[3]
    assert torch.equal(after.counts_BT, batch.history.counts_BT)
    assert torch.equal(after.crops_BTVN[..., :count], batch.history.crops_BTVN)
    assert torch.equal(after.boxes_BTVN4[..., :count, :], batch.history.boxes_BTVN4)
    assert not after.masks_BTVN[..., count:].any()


def test_whole_frames_know_no_false_detections_and_stay_bytes(demonstrations_of_several_steps):
    reader = Reader("frames", (64, 128), tokens_per_frame_pair=1)
    examples = read_examples(demonstrations_of_several_steps, reader, validation_share=0.0)
    assert examples.images.dtype == torch.uint8
    assert examples.images.shape[1:] == (3, 64, 128)
    batch = Collator(reader)(examples.training)
    assert augmented(batch, "frames", probability=1.0, generator=torch.Generator()) is batch
