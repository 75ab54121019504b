"""Distractor insertion."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from openvima.data.preprocessed import number_images, preprocess
from openvima.data.records import rollout_oracle
from openvima.env import TabletopEnv
from openvima.errors import ConfigError
from openvima.policies.processor import Processor
from openvima.training import TrainingConfig, train
from openvima.training.augmentation.demonstrations import (
    MAX_DISTRACTORS,
    allows_distractors,
    with_distractors,
)
from openvima.training.batches import BatchMaker
from openvima.training.learner import PolicyCollate
from small_data_sets import rows_of
from small_networks import rngs_of, source_of_episodes, stack_images

TASKS = ("rotate", "novel_adj", "novel_noun", "pick_in_order_then_restore", "same_shape", "rearrange")


@pytest.fixture(scope="module")
def episodes():
    def tokens(task: str):
        return preprocess(rollout_oracle(TabletopEnv(task, level="train", domain="user"), 1), "objects")

    return [tokens(task) for task in TASKS]


@pytest.fixture(scope="module")
def stacked(episodes):
    return stack_images(episodes)


def _rows(table):
    """Each object as a table of its own."""
    return table.split(np.ones(len(table), np.int64))


def _overlap(one, other) -> bool:
    for v in range(2):
        (x, y, height, width), (x2, y2, height2, width2) = (row.boxes[0, v] for row in (one, other))
        seen = one.masks[0, v] and other.masks[0, v]
        if seen and 2 * abs(x - x2) < width + width2 and 2 * abs(y - y2) < height + height2:
            return True
    return False


def test_distractors_overlap_nothing_at_any_step_and_nothing_else_changes(stacked):
    examples, stack = stacked
    added = 0
    for example in examples[:4]:
        for seed, other in enumerate(examples):
            if other is example:
                continue
            numbered = number_images([example.episode, other.episode], [example.base, other.base])
            more = with_distractors(*numbered, np.random.default_rng(seed))
            before, source = example.episode, other.episode
            first = source.objects.split(source.objects_per_step)[0]
            distractors = None
            steps = (each.objects.split(each.objects_per_step) for each in (before, more))
            for ours, theirs in zip(*steps, strict=True):
                assert np.array_equal(theirs.ids[: len(ours)], ours.ids)
                assert np.array_equal(theirs.boxes[: len(ours)], ours.boxes)
                came = theirs.select(slice(len(ours), None))
                assert distractors is None or np.array_equal(rows_of(came), rows_of(distractors))
                distractors = came
                assert not set(came.ids) & set(before.objects.ids)
                assert not any(_overlap(a, b) for a in _rows(came) for b in _rows(ours))
            assert distractors is not None and len(distractors) <= MAX_DISTRACTORS
            added += len(distractors)
            for row in _rows(distractors):
                (origin,) = (
                    k for k in _rows(first) if np.array_equal(k.crop_index + other.base, row.crop_index)
                )
                assert np.array_equal(origin.boxes, row.boxes)
                for number, whole in zip(origin.crop_index[0], row.crop_index[0], strict=True):
                    assert np.array_equal(source.images[number - 1], stack[whole].numpy())
            assert np.array_equal(more.pick_ids, before.pick_ids)
            assert np.array_equal(more.place_ids, before.place_ids)
            assert np.array_equal(more.actions, before.actions)
            assert more.prompt.text == before.prompt.text
            for part in (lambda e: e.prompt.objects, lambda e: e.final, lambda e: e.false_positives):
                own, counted = part(before).crop_index, part(more).crop_index
                assert np.array_equal(np.where(own > 0, own + example.base, 0), counted)
    assert added > 10


def test_few_tasks_receive_distractors(episodes):
    assert [allows_distractors(episode.task) for episode in episodes] == [True] * 4 + [False] * 2


def test_distractors_are_inserted_in_training_only_with_their_probability(episodes):
    collate = PolicyCollate(Processor("objects"), 0.0, with_images=True)

    def counts(share: float) -> torch.Tensor:
        make = BatchMaker(source_of_episodes(episodes), collate, 0, 99, distractor_prob=share)
        histories = [batch.history for batch, _ in make(np.arange(len(episodes)), 4)]
        return torch.cat([(each.num_slots_BT * each.steps_BT).sum(dim=1) for each in histories])

    order = np.concatenate(source_of_episodes(episodes).by_length(np.arange(len(episodes))))
    plain = torch.tensor(
        [episodes[row].objects_per_step.sum() + 2 * episodes[row].num_steps for row in order]
    )
    assert torch.equal(counts(0.0), plain)
    more = counts(1.0) - plain
    receiving = torch.tensor([allows_distractors(episodes[row].task) for row in order])
    assert (more[~receiving] == 0).all() and (more >= 0).all() and more.sum() > 0


@pytest.mark.parametrize("with_images", [True, False])
def test_a_batch_contains_the_same_images_with_either_indexing(with_images, stacked):
    examples, stack = stacked
    borrowing = [replace(e, other=o) for e, o in zip(examples[:4], examples[2:], strict=True)]
    collate = PolicyCollate(Processor("objects"), 0.0, with_images=with_images)
    batch = collate(borrowing, rngs_of(borrowing))
    images = stack if batch.images is None else batch.images
    for b, example in enumerate(borrowing):
        numbers = batch.history.crop_index_BTVN[b, 0]
        shown = {images[n].numpy().tobytes() for n in numbers.flatten().tolist() if n}
        numbered = number_images([example.episode, example.other.episode], [example.base, example.other.base])
        expected = with_distractors(*numbered, rngs_of(borrowing)[b])
        first = expected.objects.split(expected.objects_per_step)[0]
        assert shown == {stack[n].numpy().tobytes() for n in first.crop_index.flatten() if n}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"preset": "gpt-nano", "augmentation.distractor_prob": 0.5}, "takes whole frames"),
        ({"augmentation.distractor_prob": 1.5}, "augmentation.distractor_prob"),
    ],
)
def test_invalid_probabilities_are_named(settings, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        train(TrainingConfig.of({"data": tmp_path, "out": tmp_path / "run", **settings}))
