"""Batches: their order is fair, reproducible, of like length, and the same for all who share it."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch

from openvima.data import Dataset
from openvima.data.preprocessed import preprocess
from openvima.errors import ConfigError
from openvima.training.batches import BatchMaker, BatchOrder, ExampleSource, read_batches
from small_networks import source_of_episodes


def epoch_of(order: BatchOrder, epoch: int) -> list[np.ndarray]:
    count = order.batches_per_epoch
    return [order.rows(epoch * count + place) for place in range(count)]


@pytest.mark.parametrize("by_length", [False, True])
def test_an_epoch_shows_each_episode_once_and_the_next_one_in_another_order(by_length: bool) -> None:
    lengths = np.arange(100) % 7 if by_length else None
    order = BatchOrder(100, batch_size=10, seed=3, lengths=lengths, bucket=3)
    first, second = (np.concatenate(epoch_of(order, epoch)) for epoch in (0, 1))
    assert sorted(first) == sorted(second) == list(range(100))
    assert first.tolist() != second.tolist()
    assert not np.array_equal(order.rows(0), replace(order, seed=4).rows(0))


def test_what_does_not_fill_a_batch_is_left_out_and_differs_from_epoch_to_epoch() -> None:
    order = BatchOrder(13, batch_size=5, seed=0)
    left = [set(range(13)) - set(np.concatenate(epoch_of(order, epoch)).tolist()) for epoch in range(6)]
    assert {len(part) for part in left} == {3}
    assert len({frozenset(part) for part in left}) > 3


def test_ranks_divide_the_very_batches_of_one() -> None:
    lengths = np.random.default_rng(0).integers(1, 9, 96)
    whole = BatchOrder(96, batch_size=12, seed=1, lengths=lengths, bucket=2)
    ranks = [replace(whole, rank=rank, num_ranks=3) for rank in range(3)]
    for number in range(20):
        parts = [rank.rows(number) for rank in ranks]
        assert {len(part) for part in parts} == {4}
        assert sorted(np.concatenate(parts)) == sorted(whole.rows(number))
        assert np.ptp([lengths[part].sum() for part in parts]) <= 4 * 8


def test_sorting_by_length_leaves_little_to_pad() -> None:
    lengths = np.random.default_rng(0).integers(1, 9, (4000, 1))

    def padded_share(order: BatchOrder) -> float:
        batches = [lengths[rows, 0] for rows in epoch_of(order, 0)]
        return 1 - sum(b.sum() for b in batches) / sum(b.max() * len(b) for b in batches)

    plain = BatchOrder(4000, batch_size=32, seed=0)
    assert padded_share(plain) > 0.4
    assert padded_share(replace(plain, lengths=lengths)) < 0.02


def test_batches_of_all_lengths_are_spread_over_the_epoch() -> None:
    lengths = np.arange(1000) % 10
    order = BatchOrder(1000, batch_size=10, seed=0, lengths=lengths, bucket=100)
    means = np.array([lengths[rows].mean() for rows in epoch_of(order, 0)])
    assert abs(np.corrcoef(means, np.arange(len(means)))[0, 1]) < 0.25


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"batch_size": 0}, "batch_size is 0; there are 10 episodes"),
        ({"batch_size": 11}, "batch_size is 11; there are 10 episodes"),
        ({"num_ranks": 3}, "batch_size is 4; 3 ranks cannot share"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        BatchOrder(**{"num_episodes": 10, "batch_size": 4, **changes})


def numbered(rows: np.ndarray, number: int) -> tuple[int, list[int]]:
    return number, rows.tolist()


@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # on a machine of two CPUs
@pytest.mark.parametrize("workers", [0, 3])
def test_loader_workers_do_not_change_the_batches(workers: int) -> None:
    order = BatchOrder(60, batch_size=4, seed=2)
    batches = islice(read_batches(order, numbered, first=5, num_workers=workers), 30)
    assert list(batches) == [(number, order.rows(number).tolist()) for number in range(5, 35)]


def tensors(rows: np.ndarray, number: int) -> dict[str, object]:
    return {"ones": torch.ones(100), "nested": [(torch.arange(number + 1), rows)], "text": "a"}


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_batches_of_any_kind_reach_the_main_process() -> None:
    options = {"num_workers": 2, "multiprocessing_context": "fork", "timeout": 60}
    batches = read_batches(BatchOrder(8, batch_size=2, seed=0), tensors, **options)
    for number, batch in enumerate(islice(batches, 4)):
        assert batch["ones"].sum() == 100 and batch["text"] == "a"
        assert batch["nested"][0][0].tolist() == list(range(number + 1))


@pytest.fixture(scope="module")
def source(data) -> ExampleSource:
    return source_of_episodes([preprocess(demo, "objects") for demo in Dataset(data)])


def test_groups_contain_examples_of_similar_length(source) -> None:
    groups = source.by_length(np.arange(24))
    assert sorted(np.concatenate(groups)) == list(range(24))
    assert {source[index].episode.num_steps for index in groups[0]} == {1}


def test_the_parts_of_a_batch_contain_all_of_it(source) -> None:
    drawn = {}

    def collate(part, rngs):
        drawn.update({e.row: rng.random() for e, rng in zip(part, rngs, strict=True)})
        return [example.row for example in part]

    parts = BatchMaker(source, collate, seed=3, largest=5)(np.arange(24), 7)
    assert sorted(row for rows, _ in parts for row in rows) == list(range(24))
    assert max(len(rows) for rows, _ in parts) <= 5
    assert sum(steps for _, steps in parts) == sum(example.episode.num_steps for example in source)
    whole, drawn = dict(drawn), {}
    BatchMaker(source, collate, seed=3, largest=2)(np.arange(10, 24), 7)
    assert all(whole[row] == value for row, value in drawn.items())  # whoever shares the batch
    assert len(set(whole.values())) == 24
