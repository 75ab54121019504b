"""The object cache of a data set: a derived folder, written when first needed and safe to delete."""

import shlex
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, overload

import numpy as np
import pyarrow as pa

from openvima.atomic_io import NO_SPACE, folder_lock
from openvima.data.checksums import Envelope, spans_of
from openvima.data.hash_split import split_hashes
from openvima.data.manifest import CACHE_FOLDER, joint_hash
from openvima.data.object_cache.cache_file import (
    CACHE_VERSION,
    CacheFile,
    file_name,
    write_cache_file,
)
from openvima.data.object_cache.episode import PreprocessedEpisode, left_out_episode, preprocess
from openvima.data.object_cache.episode_batch import EpisodeBatch
from openvima.data.object_cache.joined_records import read_records
from openvima.data.object_cache.random_appearance import RERENDERING_VERSION, with_random_appearance
from openvima.data.reader import Dataset
from openvima.data.shard import Shard
from openvima.errors import DatasetError, ShardError, unknown_name
from openvima.input_files import as_path
from openvima.multiprocess import imap_unordered
from openvima.perception.objects import ObjectExtractor
from openvima.perception.preprocessing import KINDS, InputKind
from openvima.scene import COMPOSED

Report = Callable[[int, int, str], None]
_RERENDERED = "rerendered-v"  # in front of version and number of a random appearance


@dataclass(frozen=True, slots=True)
class Boxes:
    """A source of boxes other than the segmentation.

    Args:
        name: Identifies the extractor and all that its boxes depend on; part of the folder's name.
        make: Makes the extractor. It is sent to other processes, where it is called once.
        fraction: Fraction of the demonstrations that the cache holds; the others have no steps there. A hash
            of task and seed decides.
    """

    name: str
    make: Callable[[], ObjectExtractor] = field(compare=False)
    fraction: float = 1.0


@dataclass(frozen=True, slots=True)
class Variant:
    """How the episodes of a cache differ from the demonstrations as stored.

    Args:
        boxes: Source of the boxes; None for the segmentation.
        appearance: Number of a random appearance; None for that of the demonstrations.
    """

    boxes: Boxes | None = None
    appearance: int | None = None

    @property
    def name(self) -> str:
        """Part of the folder's name."""
        names = []
        if self.boxes:
            part = f"-{self.boxes.fraction:g}" if self.boxes.fraction < 1 else ""
            names.append(f"{self.boxes.name}{part}")
        if self.appearance is not None:
            names.append(f"{_RERENDERED}{RERENDERING_VERSION}-{self.appearance}")
        return "-".join(names)


class ObjectCache(Sequence[PreprocessedEpisode]):
    """The preprocessed episodes of a data set, in its order, each read on access.

    A cache can be sent to other processes, which reopen its files.

    Args:
        dataset: The demonstrations, perhaps of some tasks only.
        kind: "objects" for crops of the objects, "frames" for whole frames at half the size.
        folder: Folder of the cache; None means `object_cache/` in the folder of the demonstrations.
        variant: Name of the variant, as in `Variant`; empty for the demonstrations as stored.

    Raises:
        DatasetError: There is no such kind, or files are missing or older than the demonstrations;
            `open_object_cache` makes them.

    Example:
        >>> cache = open_object_cache(Dataset("demos"))
        >>> cache[0].images.shape
        (14, 3, 32, 32)
    """

    def __init__(
        self,
        dataset: Dataset,
        kind: InputKind = "objects",
        folder: str | Path | None = None,
        variant: str = "",
    ) -> None:
        self.dataset, self.kind, self.variant, self._root = dataset, kind, variant, folder
        self.folder = _cache_folder(dataset, kind, folder, variant)
        found = {source.name: _made(self.folder, source, kind, variant) for source in sources(dataset)}
        missing = [name for name, file in found.items() if file is None]
        if missing:
            option = "--boxes DETECTOR" if variant else f"--kind {kind}"
            if variant.startswith(_RERENDERED):
                option = f"--kind {kind} --rerendered {variant.rpartition('-')[2]}"
            raise DatasetError(
                f"{self.folder} lacks {len(missing)} shards, first {missing[0]}; "
                f"`openvima data preprocess {shlex.quote(str(dataset.path))} {option}` writes them."
            )
        self._files = {name: file for name, file in found.items() if file is not None}

    def __len__(self) -> int:
        return len(self.dataset)

    @overload
    def __getitem__(self, index: int) -> PreprocessedEpisode: ...
    @overload
    def __getitem__(self, index: slice) -> list[PreprocessedEpisode]: ...
    def __getitem__(self, index: int | slice) -> PreprocessedEpisode | list[PreprocessedEpisode]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        name, row = self.dataset.locate(index)
        return self._files[name][row]

    def __iter__(self) -> Iterator[PreprocessedEpisode]:
        return (self[index] for index in range(len(self)))

    def batch(self, indices: Sequence[int] | np.ndarray) -> EpisodeBatch:
        """Read several episodes together, their images when these are iterated over.

        Raises:
            ShardError: One is damaged; raised when its tables or its images are read.

        Example:
            >>> episodes = cache.batch(order.rows(0))
            >>> Processor("objects").collate(episodes).with_images(episodes.images, episodes.num_images)
        """
        return read_records([(self._files[name], row) for name, row in self.dataset.locations(indices)])

    def __reduce__(self) -> tuple[Any, ...]:  # Any: what pickle takes
        return ObjectCache, (self.dataset, self.kind, self._root, self.variant)

    def lengths(self) -> np.ndarray:
        """Return the steps of each episode and the visible objects of all of them, shape (N, 2), int64."""
        return self._gathered("num_steps", "num_objects")

    def widths(self) -> np.ndarray:
        """Return the most objects in a prompt image and in an observation, shape (N, 2), int64."""
        return self._gathered("most_in_prompt", "most_in_view")

    def image_counts(self) -> np.ndarray:
        """Return the number of images of each episode, shape (N,), int64."""
        return self._gathered("num_images")[:, 0]

    def texts(self) -> set[str]:
        """Return the different prompts, with their placeholders; "" stands for those that are left out."""
        return {text for file in self._files.values() for text in file.texts()}

    def descriptions(self) -> set[str]:
        """Return the different descriptions of object images."""
        return {text for file in self._files.values() for text in file.descriptions} - {""}

    def _gathered(self, *names: str) -> np.ndarray:
        """Read columns of the indices of all files, and put them into the order of the episodes."""
        of_file = {
            name: np.stack([file.index[column] for column in names], axis=1)
            for name, file in self._files.items()
        }
        places = self.dataset.locations(np.arange(len(self)))
        return np.array([of_file[name][row] for name, row in places], np.int64).reshape(-1, len(names))


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """One shard of demonstrations.

    Args:
        name: Of the shard.
        content_hash: Of its episodes together.
        index: Its part of the index.
    """

    name: str
    content_hash: str
    index: pa.Table


@dataclass(frozen=True, slots=True, eq=False)
class _Work:
    shard: Path
    envelope: Envelope
    source: Source
    path: Path
    kind: InputKind
    variant: Variant


def open_object_cache(
    dataset: Dataset,
    kind: InputKind = "objects",
    *,
    folder: str | Path | None = None,
    boxes: Boxes | None = None,
    appearance: int | None = None,
    workers: int = 1,
    report: Report | None = None,
    timeout_s: float = 0.0,
) -> ObjectCache:
    """Open the object cache of a data set; write what is missing, or older than the demonstrations.

    Args:
        dataset: The demonstrations, perhaps of some tasks only.
        kind: "objects" for crops of the objects, "frames" for whole frames at half the size.
        folder: Folder of the cache; None means `object_cache/` in the folder of the demonstrations.
        boxes: Extractor of the objects; None takes the segmentation. Each has a folder of its own.
        appearance: Number of a random appearance with which the demonstrations are rendered again, see
            `with_random_appearance`; each has a folder of its own. None takes the images as stored.
        workers: Number of processes.
        report: Called with episodes done, episodes in all, and a note.
        timeout_s: How long to wait for another process that writes the cache.

    Raises:
        DatasetError: There is no such kind, it has no use for boxes, or the folder cannot be written to.
        FolderLockedError: Another process writes the cache.
        ShardError: A shard is damaged.
    """
    if boxes is not None and kind == "frames":
        raise DatasetError(f"boxes are those of {boxes.name}, but whole frames have none; leave them out.")
    variant = Variant(boxes, appearance)
    target = _cache_folder(dataset, kind, folder, variant.name)
    if check_object_cache(dataset, kind, variant, folder=folder):
        with folder_lock(target, timeout_s=timeout_s):
            _write_missing(_missing(dataset, kind, target, variant), workers, report)
    return ObjectCache(dataset, kind, folder, variant.name)


def check_object_cache(
    dataset: Dataset, kind: InputKind, variant: Variant, *, folder: str | Path | None = None
) -> bool:
    """Return whether `open_object_cache` has anything to write, and make the folder for it.

    Args:
        dataset: As in `open_object_cache`.
        kind: As in `open_object_cache`.
        variant: Its boxes and appearance.
        folder: As in `open_object_cache`.

    Raises:
        DatasetError: The folder would have to be written to, and cannot be.
    """
    target = _cache_folder(dataset, kind, folder, variant.name)
    if not _missing(dataset, kind, target, variant):
        return False
    try:
        target.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=target).close()
    except OSError as error:
        if error.errno in NO_SPACE:
            raise
        raise DatasetError(
            f"cannot write the object cache to {target}: {error.strerror}. Name another folder: "
            "--object-cache of `openvima train`, --out of `openvima data preprocess`."
        ) from None
    return True


def _missing(dataset: Dataset, kind: InputKind, target: Path, variant: Variant) -> list[_Work]:
    return [
        _Work(
            dataset.path / source.name,
            Envelope.from_entry(dataset.manifest["shards"][source.name]),
            source,
            target / file_name(source.name),
            kind,
            variant,
        )
        for source in sources(dataset)
        if _made(target, source, kind, variant.name) is None
    ]


def _write_missing(work: list[_Work], workers: int, report: Report | None) -> None:
    total = sum(item.source.index.num_rows for item in work)
    work.sort(key=lambda item: -item.source.index.num_rows)

    def say(done: int) -> None:
        if report is not None:
            report(done, total, "")

    try:
        for _ in imap_unordered(_write, work, workers, report=say):
            pass  # the result of a job is its file
    finally:
        _extractor.cache_clear()  # where it was made here


def sources(dataset: Dataset) -> list[Source]:
    """List the shards that hold episodes of a data set, each with all that it holds."""
    whole = dataset if dataset.tasks is None else Dataset(dataset.path)
    shards = whole.index.column("shard").combine_chunks().dictionary_encode()
    # Episodes of a shard follow each other.
    starts = np.flatnonzero(np.diff(shards.indices.to_numpy(), prepend=-1)).tolist()
    wanted, found = set(dataset.shard_names()), []
    for start, end in zip(starts, [*starts[1:], whole.index.num_rows], strict=True):
        name = shards[start].as_py()
        if name in wanted:
            part = whole.index.slice(start, end - start)
            found.append(Source(name, joint_hash(part.column("content_hash")), part))
    return found


def _cache_folder(dataset: Dataset, kind: InputKind, folder: str | Path | None, variant: str) -> Path:
    if kind not in KINDS:
        raise DatasetError(unknown_name("kind of object cache", kind, KINDS))
    parts = (kind, f"v{CACHE_VERSION}", *((variant,) if variant else ()))
    return (as_path(folder) if folder else dataset.path / CACHE_FOLDER) / "-".join(parts)


def _made(folder: Path, source: Source, kind: InputKind, variant: str) -> CacheFile | None:
    """Open the file of a shard; None if it is missing, damaged, or of another version or content."""
    try:
        file = CacheFile(folder / file_name(source.name))
    except ShardError:
        return None
    asked = (source.content_hash, kind, variant)
    return file if (file.source, file.kind, file.variant) == asked else None


def _write(work: _Work, count: Callable[[int], None]) -> None:
    shard, episodes, variant = Shard(work.shard, work.envelope), [], work.variant
    extractor = _extractor(variant.boxes) if variant.boxes else None
    kept = split_hashes(work.source.index, "boxes/") < (variant.boxes.fraction if variant.boxes else 1.0)
    tasks, seeds = (work.source.index.column(name).to_pylist() for name in ("task", "seed"))
    for row, span in enumerate(spans_of(work.source.index)):
        is_unknown = variant.appearance is not None and tasks[row] == COMPOSED  # its prompt is not sampled
        if is_unknown or not kept[row]:
            episodes.append(left_out_episode(tasks[row], seeds[row], work.kind))
            count(row + 1)
            continue
        shard.check(row, span)
        demo = shard[row]
        if variant.appearance is None:
            episodes.append(preprocess(demo, work.kind, extractor))
        else:
            demo = with_random_appearance(demo, shard.info, variant.appearance)
            # Random appearances have no names.
            episodes.append(replace(preprocess(demo, work.kind, extractor), descriptions={}))
        count(row + 1)
    write_cache_file(work.path, episodes, work.kind, work.source.content_hash, variant.name)


@lru_cache(maxsize=1)
def _extractor(boxes: Boxes) -> ObjectExtractor:
    """Make an extractor once in this process, for all shards."""
    return boxes.make()
