"""Batches of a training: which demonstrations each takes, from which cache, and in which parts."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from openvima.data.object_cache import ObjectCache
from openvima.data.preprocessed import PreprocessedEpisode
from openvima.data.torch_dataset import send
from openvima.errors import ConfigError
from openvima.training.augmentation.demonstrations import allows_distractors


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One demonstration of a batch.

    Args:
        episode: The demonstration.
        base: Images before its own in a stack of all that are trained on: its image n has index `base + n`
            there.
        row: Its number among all demonstrations.
        other: Another one, from which objects may be inserted.
        definer: Another one, from whose prompt definitions may be inserted.
        keeps_prompt: Whether no draw exchanges its prompt for one of inverse dynamics.
    """

    episode: PreprocessedEpisode
    base: int = 0
    row: int = 0
    other: "Example | None" = None
    definer: "Example | None" = None
    keeps_prompt: bool = False


# From examples and, in training, one generator for each, to a batch.
Collate = Callable[[Sequence[Example], Sequence[np.random.Generator] | None], Any]


@dataclass(frozen=True, slots=True, eq=False)
class ExampleSource(Sequence[Example]):
    """A subset of the demonstrations of a cache.

    Args:
        cache: All demonstrations.
        rows: Their indices, ascending, shape (N,), int64.
        bases: Index of the first image of each demonstration of the cache, shape (all,), int64.
        lengths: Steps of each, and objects in view in all of them, shape (N, 2), int64.
    """

    cache: ObjectCache
    rows: np.ndarray
    bases: np.ndarray
    lengths: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> Example:  # type: ignore[override]  # nobody slices
        return self.example(int(self.rows[index]))

    def example(self, row: int) -> Example:
        """Read a demonstration by its index in the cache."""
        return Example(self.cache[row], int(self.bases[row]), row)

    def has(self, row: int) -> bool:
        """Whether a demonstration of the cache, by its index there, is one of these."""
        place = int(np.searchsorted(self.rows, row))
        return place < len(self.rows) and int(self.rows[place]) == row

    def num_steps(self, indices: np.ndarray) -> int:
        """Return the total steps of some demonstrations."""
        return int(self.lengths[indices, 0].sum())

    def by_length(self, indices: np.ndarray) -> list[np.ndarray]:
        """Group demonstrations of 1, of 2 or 3, and of more steps, to reduce padding."""
        keys = np.minimum(2, self.lengths[indices, 0] // 2)
        return [indices[keys == key] for key in np.unique(keys)]


@dataclass(frozen=True, slots=True)
class BatchMaker:
    """Makes the batches of a process, each in parts of similar length.

    Args:
        source: The demonstrations.
        collate: Makes a batch of each part.
        seed: Of the run; every example of every batch has its own generator.
        largest: Maximum size of a part.
        alternatives: Other caches of the same demonstrations, each with the probability of using it instead
            where it has the demonstration; see `training.source.alternative_source`.
        distractor_prob: Probability of inserting distractors from another demonstration, for those that allow
            it; see `with_distractors`.
        definers: Demonstrations, by their index in the cache, whose prompts define words.
        unused_definitions_prob: Probability of inserting such sentences of one of them, see
            `with_unused_definitions`.
        first_batches: Number of batches, the first ones, whose demonstrations keep their prompts.
    """

    source: ExampleSource
    collate: Collate
    seed: int
    largest: int
    alternatives: tuple[tuple[ExampleSource, float], ...] = ()
    distractor_prob: float = 0.0
    definers: Sequence[int] = ()
    unused_definitions_prob: float = 0.0
    first_batches: int = 0

    def __call__(self, indices: np.ndarray, number: int) -> list[tuple[Any, int]]:
        """Return the parts of one batch, each with its number of demonstration steps."""
        parts = []
        groups = self.source.by_length(indices)
        for part in (g[i : i + self.largest] for g in groups for i in range(0, len(g), self.largest)):
            rows = self.source.rows[part].tolist()
            rngs = [np.random.default_rng([self.seed, number, row]) for row in rows]
            examples = [self._draw(row, rng) for row, rng in zip(rows, rngs, strict=True)]
            if number < self.first_batches:
                examples = [replace(example, keeps_prompt=True) for example in examples]
            parts.append((self.collate(examples, rngs), self.source.num_steps(part)))
        return parts

    def _draw(self, row: int, rng: np.random.Generator) -> Example:
        """Draw which cache an example is from, and the sources of its distractors and unused definitions."""
        source = self.source
        if self.alternatives:
            drawn, ends = rng.random(), np.cumsum([prob for _, prob in self.alternatives])
            if drawn < ends[-1]:
                other, _ = self.alternatives[np.searchsorted(ends, drawn, side="right")]
                source = other if other.has(row) else source
        example, prob = source.example(row), self.distractor_prob
        if prob and allows_distractors(example.episode.task) and rng.random() < prob:
            example = replace(example, other=self.source[int(rng.integers(len(self.source)))])
        if self.definers and rng.random() < self.unused_definitions_prob:
            definer = self.definers[int(rng.integers(len(self.definers)))]
            example = replace(example, definer=self.source.example(definer))
        return example


@dataclass(frozen=True, slots=True, eq=False)
class BatchOrder:
    """The batches of every epoch, as a function of a few numbers.

    An epoch shows each episode once, but for a remainder that does not fill a batch. Batches are numbered
    through all epochs; number n is the same whoever asks for it, with however many loader workers, and after
    however many interruptions. Ranks divide the same batches among themselves, so that a run on several
    devices sees what a run on one sees.

    Args:
        num_episodes: Episodes of the data set.
        batch_size: Episodes of a batch, of all ranks together.
        seed: Decides the order.
        lengths: Lengths of the episodes, shape (N,) or (N, columns), the first column counting most. Batches
            are then made of episodes of like length, which leaves little to pad.
        bucket: Batches among which episodes are sorted by length, if lengths are given. The more, the less
            padding; the fewer, the more any episode can meet any other.
        rank: This process among those that divide the batches.
        num_ranks: Number of them.
        first_batches: Number of batches, the first ones, that take `first_episodes` alone.
        first_episodes: Some of the episodes.

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
    lengths: np.ndarray | None = None
    bucket: int = 50
    rank: int = 0
    num_ranks: int = 1
    first_batches: int = 0
    first_episodes: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.batch_size % self.num_ranks:
            raise ConfigError(
                f"batch_size is {self.batch_size}; {self.num_ranks} ranks cannot share that equally."
            )
        if not 1 <= self.batch_size <= self.num_episodes:
            raise ConfigError(f"batch_size is {self.batch_size}; there are {self.num_episodes} episodes.")

    @property
    def batches_per_epoch(self) -> int:
        """Number of batches of an epoch."""
        return self.num_episodes // self.batch_size

    def rows(self, number: int) -> np.ndarray:
        """Return the episodes of one batch that are this rank's.

        Args:
            number: Of the batch, from 0, through all epochs.

        Returns:
            Shape (batch_size / num_ranks,), int64.
        """
        return self.rows_of_all(number)[self.rank :: self.num_ranks]

    def rows_of_all(self, number: int) -> np.ndarray:
        """Return the episodes of one batch, those of all ranks."""
        epoch, place = divmod(number, self.batches_per_epoch)
        rows, order = _order_of_epoch(self, epoch)
        start = order[place] * self.batch_size
        rows = rows[start : start + self.batch_size]
        if self.first_episodes is not None and number < self.first_batches:
            rows = self.first_episodes[rows % len(self.first_episodes)]
        return rows


@lru_cache(maxsize=2)
def _order_of_epoch(order: BatchOrder, epoch: int) -> tuple[np.ndarray, np.ndarray]:
    """Episodes of an epoch in the order in which batches are cut, and the order of the batches."""
    rng = np.random.default_rng([order.seed, epoch])
    rows = rng.permutation(order.num_episodes)
    num_rows = order.batches_per_epoch * order.batch_size
    if order.lengths is not None:
        keys = np.reshape(order.lengths, (order.num_episodes, -1)).T[::-1]
        span = order.bucket * order.batch_size
        for start in range(0, num_rows, span):
            part = rows[start : min(start + span, num_rows)]
            rows[start : start + len(part)] = part[np.lexsort(keys[:, part])]
    return rows, rng.permutation(order.batches_per_epoch)


class BatchStream(IterableDataset):
    """Batches in a given order; loader workers share them out.

    Worker w of W takes every W-th batch. A `DataLoader` asks its workers in turn, so the batches come in the
    same order whatever their number.

    Args:
        order: Which episodes each batch takes.
        make: Makes a batch of their indices and its own number, which may seed what it draws. It is sent to
            the workers, so that it must be a function of a module or an object that can be pickled.
        first: Number of the first batch.
    """

    def __init__(self, order: BatchOrder, make: Callable[[np.ndarray, int], Any], first: int = 0) -> None:
        self.order, self.make, self.first = order, make, first

    def __iter__(self) -> Iterator[Any]:
        worker = get_worker_info()
        number, stride = (self.first, 1) if worker is None else (self.first + worker.id, worker.num_workers)
        while True:
            yield self.make(self.order.rows(number), number)
            number += stride


def read_batches(
    order: BatchOrder,
    make: Callable[[np.ndarray, int], Any],
    *,
    first: int = 0,
    **options: Any,
) -> DataLoader:
    """Return a loader of batches without an end, perhaps read ahead.

    Args:
        order: As in `BatchStream`.
        make: As in `BatchStream`.
        first: Number of the first batch: an interrupted training resumes at the one that comes next.
        **options: Of `DataLoader`, such as `num_workers`.

    Example:
        >>> cache, processor = open_object_cache(Dataset("demos")), Processor("objects")
        >>> order = BatchOrder(len(cache), batch_size=64, seed=0, lengths=cache.lengths())
        >>> def make(rows, number):
        ...     return processor.collate(number_images([cache[row] for row in rows]))
        >>> for batch in read_batches(order, make, num_workers=2): ...
    """
    # Batches come as they are made; without a generator of its own the loader would draw from the global one.
    stream, generator = BatchStream(order, make, first), torch.Generator()
    return DataLoader(stream, batch_size=None, collate_fn=send, generator=generator, **options)
