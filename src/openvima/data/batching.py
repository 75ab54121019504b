"""Which episodes each batch takes: shuffled, of like length, and divided among ranks."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from openvima.errors import ConfigError


@dataclass(frozen=True, slots=True, eq=False)
class BatchOrder:
    """The batches of every epoch, as a function of a few numbers.

    An epoch shows each episode once. Batches are numbered through all epochs; number n is the same whoever
    asks for it, with however many loader workers, and after however many interruptions. Ranks divide the same
    batches among themselves, so that a run on several devices sees what a run on one sees.

    Args:
        num_episodes: Episodes of the data set.
        batch_size: Episodes of a batch, of all ranks together.
        seed: Decides the order.
        shuffle: Draw a fresh permutation for each epoch; without, episodes come as they are stored.
        lengths: Lengths of the episodes, shape (N,) or (N, columns), the first column counting most. Batches
            are then made of episodes of like length, which leaves little to pad.
        bucket: Batches among which episodes are sorted by length, if lengths are given. The more, the less
            padding; the fewer, the more any episode can meet any other.
        drop_last: Leave out the remainder of an epoch that does not fill a batch; another one each epoch.
        rank: This process among those that divide the batches.
        num_ranks: Number of them.

    Raises:
        ConfigError: Numbers that cannot be, or that do not fit together.

    Example:
        >>> order = BatchOrder(10, batch_size=4, seed=0)
        >>> [rows.tolist() for rows in (order.rows(0), order.rows(1))]
        [[4, 6, 2, 7], [3, 5, 9, 0]]
    """

    num_episodes: int
    batch_size: int
    seed: int = 0
    shuffle: bool = True
    lengths: np.ndarray | None = None
    bucket: int = 50
    drop_last: bool = True
    rank: int = 0
    num_ranks: int = 1

    def __post_init__(self) -> None:
        problems = []
        if self.batch_size < 1:
            problems.append(f"batch_size is {self.batch_size}; it must be at least 1.")
        if self.bucket < 1:
            problems.append(f"bucket is {self.bucket}; it must be at least 1.")
        if not 0 <= self.seed < 2**63:
            problems.append(f"seed is {self.seed}; it must lie within 0 … 2^63 - 1.")
        if self.num_ranks < 1 or not 0 <= self.rank < self.num_ranks:
            problems.append(f"rank is {self.rank} of {self.num_ranks}; count ranks from 0.")
        elif self.batch_size % self.num_ranks:
            problems.append(
                f"batch_size is {self.batch_size}; {self.num_ranks} ranks cannot share that equally."
            )
        elif self.num_ranks > 1 and not self.drop_last:
            problems.append("drop_last is False; ranks could not share the last batch equally.")
        if self.lengths is not None and len(self.lengths) != self.num_episodes:
            problems.append(f"there are {len(self.lengths)} lengths for {self.num_episodes} episodes.")
        if not problems and self.batches_per_epoch < 1:
            problems.append(f"batch_size is {self.batch_size}; there are {self.num_episodes} episodes.")
        if problems:
            raise ConfigError(" ".join(problems))

    @property
    def batches_per_epoch(self) -> int:
        """Number of batches of an epoch."""
        whole, rest = divmod(self.num_episodes, self.batch_size)
        return whole + bool(rest and not self.drop_last)

    def rows(self, number: int) -> np.ndarray:
        """Return the episodes of one batch that are this rank's.

        Args:
            number: Of the batch, from 0, through all epochs.

        Returns:
            Shape (batch_size / num_ranks,), int64; the last batch of an epoch may be shorter if none is
            dropped.
        """
        return self.rows_of_all(number)[self.rank :: self.num_ranks]

    def rows_of_all(self, number: int) -> np.ndarray:
        """Return the episodes of one batch, those of all ranks."""
        epoch, place = divmod(number, self.batches_per_epoch)
        rows, order = _epoch(self, epoch)
        start = order[place] * self.batch_size
        return rows[start : start + self.batch_size]

    def settings(self) -> dict[str, int | bool]:
        """Return what decides which episodes a batch takes."""
        names = ("num_episodes", "batch_size", "seed", "shuffle", "bucket", "drop_last")
        return {**{name: getattr(self, name) for name in names}, "by_length": self.lengths is not None}


@lru_cache(maxsize=2)
def _epoch(order: BatchOrder, epoch: int) -> tuple[np.ndarray, np.ndarray]:
    """Episodes of an epoch in the order in which batches are cut, and the order of the batches."""
    rng = np.random.default_rng([order.seed, epoch])
    rows = rng.permutation(order.num_episodes) if order.shuffle else np.arange(order.num_episodes)
    num_whole = order.num_episodes // order.batch_size
    batches = np.arange(order.batches_per_epoch)
    if order.lengths is not None:
        keys = np.reshape(order.lengths, (order.num_episodes, -1)).T[::-1]
        span = order.bucket * order.batch_size
        for start in range(0, num_whole * order.batch_size, span):
            part = rows[start : min(start + span, num_whole * order.batch_size)]
            rows[start : start + len(part)] = part[np.lexsort(keys[:, part])]
    if order.shuffle:  # the remainder, if it is kept, stays at the end
        batches[:num_whole] = rng.permutation(num_whole)
    return rows, batches
