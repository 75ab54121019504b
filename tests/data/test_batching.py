"""The order of batches: fair, reproducible, of like length, and the same for all who share it."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from openvima.data.batching import BatchOrder
from openvima.errors import ConfigError


def epoch_of(order: BatchOrder, epoch: int) -> list[np.ndarray]:
    count = order.batches_per_epoch
    return [order.rows(epoch * count + place) for place in range(count)]


@pytest.mark.parametrize("by_length", [False, True])
def test_an_epoch_shows_each_episode_once_and_the_next_one_in_another_order(by_length: bool) -> None:
    lengths = np.arange(103) % 7 if by_length else None
    order = BatchOrder(103, batch_size=10, seed=3, lengths=lengths, bucket=3, drop_last=False)
    first, second = (np.concatenate(epoch_of(order, epoch)) for epoch in (0, 1))
    assert sorted(first) == sorted(second) == list(range(103))
    assert first.tolist() != second.tolist()
    assert len(epoch_of(order, 0)[-1]) == 3


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


def test_the_first_column_of_lengths_counts_most() -> None:
    lengths = np.array([[2, 1], [1, 9], [1, 3], [2, 0]])
    order = BatchOrder(4, batch_size=2, shuffle=False, lengths=lengths)
    assert [rows.tolist() for rows in epoch_of(order, 0)] == [[2, 1], [3, 0]]


def test_batches_of_all_lengths_are_spread_over_the_epoch() -> None:
    lengths = np.arange(1000) % 10
    order = BatchOrder(1000, batch_size=10, seed=0, lengths=lengths, bucket=100)
    means = np.array([lengths[rows].mean() for rows in epoch_of(order, 0)])
    assert abs(np.corrcoef(means, np.arange(len(means)))[0, 1]) < 0.25


def test_neighbours_of_one_epoch_are_strangers_in_the_next() -> None:
    order = BatchOrder(2000, batch_size=20, seed=0)
    together = [{frozenset(pair) for rows in epoch_of(order, e) for pair in _pairs(rows)} for e in (0, 1)]
    by_chance = len(together[0]) * 19 / 1999
    assert abs(len(together[0] & together[1]) - by_chance) < 5 * np.sqrt(by_chance)


def _pairs(rows: np.ndarray) -> list[tuple[int, int]]:
    return [(int(a), int(b)) for i, a in enumerate(rows) for b in rows[i + 1 :]]


def test_without_shuffling_episodes_come_as_they_are_stored() -> None:
    order = BatchOrder(7, batch_size=3, shuffle=False, drop_last=False)
    assert [rows.tolist() for rows in epoch_of(order, 5)] == [[0, 1, 2], [3, 4, 5], [6]]


def test_the_order_follows_from_its_numbers_alone() -> None:
    order = BatchOrder(50, batch_size=7, seed=9)
    copy = pickle.loads(pickle.dumps(order))
    assert all(np.array_equal(order.rows(n), copy.rows(n)) for n in (40, 3, 17))
    assert not np.array_equal(order.rows(0), replace(order, seed=10).rows(0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"batch_size": 0}, "batch_size is 0; it must be at least 1"),
        ({"batch_size": 11}, "batch_size is 11; there are 10 episodes"),
        ({"bucket": 0}, "bucket is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"rank": 2, "num_ranks": 2}, "rank is 2 of 2"),
        ({"num_ranks": 3}, "batch_size is 4; 3 ranks cannot share"),
        ({"num_ranks": 2, "drop_last": False}, "could not share the last batch"),
        ({"lengths": np.ones(9)}, "there are 9 lengths for 10 episodes"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        BatchOrder(**{"num_episodes": 10, "batch_size": 4, **changes})
