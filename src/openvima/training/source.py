"""The demonstrations of a run, from the object cache: training split, validation split, and batches."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from openvima.data.batching import BatchOrder
from openvima.data.hash_split import split_hashes
from openvima.data.hub import data_folder
from openvima.data.object_cache.cache import ObjectCache
from openvima.data.reader import Dataset, read_manifest
from openvima.errors import ConfigError, DatasetError, unknown_name
from openvima.perception.preprocessing import split_prompt
from openvima.policies.processor import Processor
from openvima.tasks.registry import list_tasks
from openvima.training.augmentation.describe_objects import text_of
from openvima.training.augmentation.distractor_insertion import allows_distractors
from openvima.training.dataset import Example, StoredEpisode
from openvima.training.learner import Collate
from openvima.training.provenance import held_out_demonstrations

_PRIOR_DEMONSTRATIONS = 10_000  # enough for the marginals of 100 bins


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
        row = int(self.rows[index])
        content = StoredEpisode(self.cache, row, int(self.lengths[index, 0]))
        return Example(content, int(self.bases[row]), row)

    def example(self, row: int) -> Example:
        """Return a demonstration by its index in the cache."""
        return Example(self.cache[row], int(self.bases[row]), row)

    def has(self, row: int) -> bool:
        """Whether a demonstration of the cache, by its index there, is one of these."""
        place = int(np.searchsorted(self.rows, row))
        return place < len(self.rows) and int(self.rows[place]) == row

    def num_steps(self, indices: np.ndarray) -> int:
        """Return the total steps of some demonstrations."""
        return int(self.lengths[indices, 0].sum())


@dataclass(frozen=True, slots=True)
class Parts:
    """Collates the batch of a process in parts of similar length.

    Args:
        collate: Makes a batch of each part.
        seed: Of the run; every example of every batch has its own generator.
        largest: Maximum size of a part.
        count: Number of parts, whatever the lengths; None is as many as needed.
        alternatives: Other caches of the same demonstrations, each with the probability of using it instead
            where it has the demonstration; see `alternative_source`.
        distractors: Demonstrations from which distractors are inserted; see `with_distractors`.
        distractor_prob: Probability of that, for demonstrations that allow it.
    """

    collate: Collate
    seed: int
    largest: int
    count: int | None = None
    alternatives: tuple[tuple[ExampleSource, float], ...] = ()
    distractors: ExampleSource | None = None
    distractor_prob: float = 0.0

    def __call__(self, examples: Sequence[Example], number: int) -> list[tuple[object, int]]:
        """Return the parts of one batch, each with its number of demonstration steps."""
        parts = []
        for part in self._divided(examples):
            rngs = [np.random.default_rng([self.seed, number, example.row]) for example in part]
            drawn = [self._drawn(example, rng) for example, rng in zip(part, rngs, strict=True)]
            parts.append((self.collate(drawn, rngs), sum(e.num_steps for e in part)))
        return parts

    def _drawn(self, example: Example, rng: np.random.Generator) -> Example:
        """Draw which cache an example is from, and the source of its distractors."""
        if self.alternatives:
            drawn, sources = rng.random(), [source for source, _ in self.alternatives]
            ends = np.cumsum([prob for _, prob in self.alternatives])
            if drawn < ends[-1]:
                source = sources[int(np.searchsorted(ends, drawn, side="right"))]
                example = source.example(example.row) if source.has(example.row) else example
        others = self.distractors
        if (
            others is None
            or not allows_distractors(example.episode.task)
            or rng.random() >= self.distractor_prob
        ):
            return example
        return replace(example, other=others[int(rng.integers(len(others)))])

    def _divided(self, examples: Sequence[Example]) -> list[Sequence[Example]]:
        if self.count is not None:
            ordered = sorted(examples, key=lambda example: example.num_steps)
            ends = [len(ordered) * part // self.count for part in range(self.count + 1)]
            return [ordered[start:end] for start, end in pairwise(ends)]
        size = self.largest
        return [
            group[start : start + size]
            for group in by_length(examples)
            for start in range(0, len(group), size)
        ]


def open_demonstrations(
    folder: Path, excluded: Sequence[str] = (), *, allow_heldout: bool = False
) -> Dataset:
    """Open a folder of demonstrations without those of some tasks, for training.

    Args:
        folder: The folder.
        excluded: Names of tasks; the folder need not have any of them.
        allow_heldout: Accept demonstrations that are held out for evaluation.

    Raises:
        ConfigError: There is no such task, or no other one is left.
        DatasetError: The folder is no finished data set, or holds demonstrations that are held out.
    """
    dataset = _without_tasks(folder, excluded)
    if (found := held_out_demonstrations(dataset)) and not allow_heldout:
        raise DatasetError(
            f"{folder} holds demonstrations for evaluation only: {', '.join(found)}. Train on level train, "
            "leave these tasks out, or give --allow-heldout, which is recorded with the policy."
        )
    return dataset


def _without_tasks(folder: Path, excluded: Sequence[str]) -> Dataset:
    if not excluded:
        return Dataset(folder)
    folder = data_folder(folder)
    present = sorted(read_manifest(folder)["tasks"])
    known = {*present, *list_tasks()}
    if problems := [
        unknown_name("task", name, known, f"{folder} has {', '.join(present)}.")
        for name in excluded
        if name not in known
    ]:
        raise ConfigError(f"loader.exclude_tasks: {' '.join(problems)}")
    kept = [task for task in present if task not in excluded]
    if not kept:
        raise ConfigError(
            f"loader.exclude_tasks is {', '.join(excluded)}; {folder} has no other task, only "
            f"{', '.join(present)}."
        )
    return Dataset(folder, tasks=kept)


def split_examples(
    cache: ObjectCache, *, validation_fraction: float, validation_episodes: int
) -> tuple[ExampleSource, ExampleSource]:
    """Split demonstrations into training and validation.

    The split follows from task and seed, so that it stays the same when data are added.

    Args:
        cache: All demonstrations.
        validation_fraction: Fraction to hold out.
        validation_episodes: Maximum number of them.

    Raises:
        DatasetError: There is none to train on.
    """
    hashes = split_hashes(cache.dataset.index)
    counts = cache.image_counts()
    bases = np.cumsum(counts) - counts
    lengths = cache.lengths()
    training, kept = (
        np.flatnonzero(hashes >= validation_fraction),
        np.flatnonzero(hashes < validation_fraction),
    )
    if not len(training):
        raise DatasetError(
            "there is no demonstration to train on; generate some, or lower loader.validation_fraction."
        )
    kept = np.sort(kept[np.argsort(hashes[kept], kind="stable")[:validation_episodes]])
    first, second = (ExampleSource(cache, rows, bases, lengths[rows]) for rows in (training, kept))
    return first, second


def alternative_source(cache: ObjectCache, source: ExampleSource, first_image: int) -> ExampleSource:
    """Return the demonstrations of a source as another cache has them.

    Args:
        cache: Of detected boxes, or of random appearance; it may lack some of them.
        source: The demonstrations.
        first_image: Number of its first image: its images follow those of other caches.
    """
    counts = cache.image_counts()
    bases = np.cumsum(counts) - counts + first_image
    lengths = cache.lengths()
    rows = source.rows[lengths[source.rows, 0] > 0]
    return ExampleSource(cache, rows, bases, lengths[rows])


def demonstrated_actions(source: ExampleSource) -> torch.Tensor:
    """Return the actions of evenly spaced demonstrations, (N, 12), for the prior of an action head."""
    stride = max(1, len(source) // _PRIOR_DEMONSTRATIONS)
    rows = range(0, len(source), stride)
    return torch.from_numpy(np.concatenate([source[row].episode.actions for row in rows]))


def check_words(cache: ObjectCache, processor: Processor, *, describes: bool = False) -> None:
    """Check before training that T5 has the words of every prompt; other vocabularies are built of them.

    Args:
        cache: All demonstrations.
        processor: It has the tokenizer.
        describes: Whether descriptions take the place of object images.

    Raises:
        PromptError: A prompt has a word that T5 lacks.
    """
    for text in (*cache.texts(), *(map(text_of, cache.descriptions()) if describes else ())):
        for piece in split_prompt(text):
            if isinstance(piece, str):
                processor.tokenizer.encode(piece)


def order_of(
    source: ExampleSource, *, batch_size: int, seed: int, bucket: int, rank: int, num_ranks: int
) -> BatchOrder:
    """Return the order of demonstrations; a batch is at most as large as the data.

    Raises:
        ConfigError: The processes cannot share the demonstrations, or a batch of them, equally.
    """
    if len(source) < num_ranks:
        raise ConfigError(
            f"there are {len(source)} demonstrations to train on and {num_ranks} processes; start fewer of "
            "these, or generate more."
        )
    batch_size = min(batch_size, len(source) // num_ranks * num_ranks)
    return BatchOrder(
        len(source),
        batch_size=batch_size,
        seed=seed,
        lengths=source.lengths if bucket else None,
        bucket=max(1, bucket),
        rank=rank,
        num_ranks=num_ranks,
    )


def by_length(examples: Sequence[Example]) -> list[list[Example]]:
    """Group examples of 1, of 2 or 3, and of more steps, to reduce padding."""
    groups: dict[int, list[Example]] = {}
    for example in examples:
        groups.setdefault(min(2, example.num_steps // 2), []).append(example)
    return [groups[key] for key in sorted(groups)]
