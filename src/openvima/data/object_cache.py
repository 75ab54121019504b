"""The object cache: crops and boxes of all demonstrations, cut once for all trainings.

A derived folder, written when first needed and safe to delete. It has an Arrow file for each shard, with one
row per demonstration, uncompressed and memory-mapped: a demonstration that is read is a set of views into it.
"""

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from math import prod
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from xxhash import xxh3_64

from openvima.atomic_io import atomic_write, folder_lock
from openvima.data.encoding import list_rows
from openvima.data.manifest import CACHE_FOLDER, joint_hash, split_index
from openvima.data.preprocessed import FalsePositives, PreprocessedEpisode, preprocess
from openvima.data.reader import Dataset, split_hashes
from openvima.data.rerender import RERENDERING_VERSION, with_random_appearance
from openvima.data.shard import DAMAGE_ERRORS, SPAN, Shard, map_file
from openvima.errors import DatasetError, one_line, unknown_name
from openvima.input_files import as_path
from openvima.multiprocess import Report, imap_unordered
from openvima.perception.objects import ObjectExtractor
from openvima.perception.preprocessing import (
    IMAGE_SIZES,
    KINDS,
    InputKind,
    ObjectTable,
    PreprocessedPrompt,
    image_names,
)
from openvima.scene import COMPOSED

CACHE_VERSION = 7  # grows whenever the same demonstration gives another row
# Columns of lists, one record for each object, step or image: shape and NumPy type of each field, which has
# the name that it has in `PreprocessedEpisode`.
_Fields = dict[str, str]
_OBJECT: _Fields = {"ids": "i2", "crop_index": "(2,)i4", "boxes": "(2,4)i2", "grasps": "(2,2)i2"}
_LISTS: dict[str, _Fields] = {
    "prompt_images": {"prompt.objects_per_image": "i2", "prompt.is_scene": "?"},
    **{
        column: {f"{path}.{name}": dtype for name, dtype in _OBJECT.items()}
        for column, path in (("prompt_objects", "prompt.objects"), ("objects", "objects"), ("final", "final"))
    },
    "steps": {
        "objects_per_step": "i2",
        "pick_ids": "i2",
        "place_ids": "i2",
        "false_positives.crop_index": "(2,)i4",
        "false_positives.boxes": "(2,4)i2",
        "actions": "(12,)f4",
    },
}
_SCALARS = {
    "task": pa.string(),
    "seed": pa.int64(),
    "end_effector": pa.int8(),
    "text": pa.string(),
    "descriptions": pa.list_(pa.string()),  # one for each prompt image; "" where there is none
}
_CHECKSUM = "checksum"  # of a row, compared at every read
LeftOut = tuple[str, int]  # task and seed of a demonstration that a cache leaves out


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
        boxes, names = self.boxes, []
        if boxes:
            names.append(boxes.name if boxes.fraction == 1 else f"{boxes.name}-{boxes.fraction:g}")
        if self.appearance is not None:
            names.append(f"rerendered-v{RERENDERING_VERSION}-{self.appearance}")
        return "-".join(names)


class CacheFile:
    """One file of the object cache, memory-mapped.

    Args:
        path: The file.
        kind: As for `write_cache_file`.
        source: As for `write_cache_file`.
        variant: As for `write_cache_file`.

    Raises:
        DatasetError: It is missing, truncated, or of another version, kind, source or variant.
    """

    def __init__(self, path: Path, kind: InputKind, source: str, variant: str = "") -> None:
        self.path = path
        try:
            reader = pa.ipc.open_file(pa.py_buffer(map_file(path)))
            if not reader.schema.equals(_schema(kind, source, variant), check_metadata=True):
                raise ValueError("it is of other demonstrations, or another version or variant")
            rows = reader.get_batch(0)
            rows.validate(full=True)  # no list reaches beyond its records
            self._lists = {name: _unpack(rows.column(name), fields) for name, fields in _lists(kind).items()}
            self._scalars = {name: rows.column(name).to_pylist() for name in _SCALARS}
            self._checksums = rows.column(_CHECKSUM).to_pylist()
        except DAMAGE_ERRORS as error:
            raise _damage(path, one_line(error)) from None

    def __len__(self) -> int:
        return len(self._checksums)

    def __getitem__(self, row: int) -> PreprocessedEpisode:
        arrays = {}
        for ends, fields in self._lists.values():
            start, end = ends[row : row + 2].tolist()
            for name, flat in fields.items():
                arrays[name] = flat[start:end]
        scalars = tuple([column[row] for column in self._scalars.values()])
        if _checksum(scalars, arrays.values()) != self._checksums[row]:
            raise _damage(self.path, f"the checksum of row {row} of {len(self)} is wrong")
        task, seed, end_effector, text, descriptions = scalars
        in_prompt, objects, final = (
            ObjectTable(*(arrays[f"{path}.{name}"] for name in _OBJECT))
            for path in ("prompt.objects", "objects", "final")
        )
        shown = arrays["prompt.objects_per_image"], arrays["prompt.is_scene"]
        spurious = arrays["false_positives.crop_index"], arrays["false_positives.boxes"]
        names = "objects_per_step", "pick_ids", "place_ids", "actions", "images"
        described = zip(image_names(text), descriptions, strict=True)
        return PreprocessedEpisode(
            task=task,
            seed=seed,
            end_effector=end_effector,
            prompt=PreprocessedPrompt(text, in_prompt, *shown),
            objects=objects,
            false_positives=FalsePositives(*spurious),
            final=final,
            descriptions={name: texts for name, texts in described if texts},
            **{name: arrays[name] for name in names},
        )

    def counts(self, column: str) -> np.ndarray:
        """Return the length of a list in each row, shape (N,), int64."""
        return np.diff(self._lists[column][0])


def write_cache_file(
    path: Path,
    episodes: Sequence[PreprocessedEpisode | LeftOut],
    kind: InputKind,
    source: str,
    variant: str = "",
) -> None:
    """Write one file of the object cache, under its name only when it is complete.

    Args:
        path: The file.
        episodes: What to write; a demonstration that is left out gets a row without steps.
        kind: What their images show.
        source: Content hash of the demonstrations that they were made of.
        variant: How the episodes differ from these, as in `Variant`; empty if they do not.
    """
    schema = _schema(kind, source, variant)
    scalars = [_scalars(episode) for episode in episodes]
    lists = _lists(kind)
    arrays = {
        name: [_array(episode, name, dtype) for episode in episodes]
        for fields in lists.values()
        for name, dtype in fields.items()
    }
    checksums = [_checksum(*row) for row in zip(scalars, zip(*arrays.values(), strict=True), strict=True)]
    columns = [_pack({name: arrays[name] for name in fields}) for fields in lists.values()]
    columns += map(pa.array, zip(*scalars, strict=True), _SCALARS.values())
    columns.append(pa.array(checksums, pa.uint64()))
    with atomic_write(path) as file, pa.ipc.new_file(file, schema) as writer:
        writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))


def _lists(kind: InputKind) -> dict[str, _Fields]:
    height, width = IMAGE_SIZES[kind]
    return {**_LISTS, "images": {"images": f"(3,{height},{width})u1"}}


def _schema(kind: InputKind, source: str, variant: str) -> pa.Schema:
    lists = {
        column: pa.list_(pa.struct({name: _arrow_type(dtype) for name, dtype in fields.items()}))
        for column, fields in _lists(kind).items()
    }
    about = {"version": str(CACHE_VERSION), "kind": kind, "source": source, "variant": variant}
    return pa.schema({**lists, **_SCALARS, _CHECKSUM: pa.uint64()}, about)


def _arrow_type(dtype: str) -> pa.DataType:
    number, shape = pa.from_numpy_dtype(np.dtype(dtype).base), np.dtype(dtype).shape
    return pa.list_(number, prod(shape)) if shape else number


def _pack(fields: Mapping[str, Sequence[np.ndarray]]) -> pa.Array:
    """Put arrays of each row, which differ in length from row to row, into a column of lists of records."""
    columns = [list_rows(np.concatenate(arrays)) for arrays in fields.values()]
    ends = np.cumsum([0, *map(len, next(iter(fields.values())))])
    records = pa.StructArray.from_arrays(columns, [*fields])
    return pa.ListArray.from_arrays(pa.array(ends, pa.int32()), records)


def _unpack(column: pa.Array, fields: _Fields) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return where the lists of a column begin and end, and all records, field by field, without a copy."""
    flat = {}
    for name, dtype in fields.items():
        values, shape = column.values.field(name), np.dtype(dtype).shape
        numbers = (values.values if shape else values).to_numpy(zero_copy_only=False)
        flat[name] = numbers.reshape(-1, *shape)
    return column.offsets.to_numpy(), flat


def _array(episode: PreprocessedEpisode | LeftOut, name: str, dtype: str) -> np.ndarray:
    """Return one of the arrays of a row."""
    if isinstance(episode, tuple):
        return np.zeros(0, dtype)  # of the shape that is part of the type
    return np.ascontiguousarray(attrgetter(name)(episode))


def _scalars(episode: PreprocessedEpisode | LeftOut) -> tuple[object, ...]:
    """Return what a row has besides its arrays, in the order of `_SCALARS`."""
    if isinstance(episode, tuple):
        return *episode, 0, "", []
    prompt = episode.prompt
    descriptions = [episode.descriptions.get(name, "") for name in prompt.image_names]
    return episode.task, episode.seed, episode.end_effector, prompt.text, descriptions


def _checksum(scalars: tuple[object, ...], arrays: Iterable[np.ndarray]) -> int:
    """Return the xxh3 of a row, 64 bits."""
    digest = xxh3_64(repr(scalars).encode())
    for array in arrays:
        digest.update(array)  # type: ignore[arg-type]  # it is a buffer
    return digest.intdigest()


def _damage(path: Path, reason: str) -> DatasetError:
    return DatasetError(
        f"{path} is no readable file of the object cache ({reason}). Delete it; `openvima data preprocess` "
        "makes it anew."
    )


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
        self._files, missing = _open_files(self.folder, dataset, kind, variant)
        if missing:
            raise DatasetError(
                f"{self.folder} lacks {len(missing)} shards, first {next(iter(missing))}; `openvima data "
                "preprocess` writes them."
            )

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> PreprocessedEpisode:  # type: ignore[override]  # nobody slices
        name, row = self.dataset.locate(index)
        return self._files[name][row]

    def __reduce__(self) -> tuple[Any, ...]:
        return ObjectCache, (self.dataset, self.kind, self._root, self.variant)

    def lengths(self) -> np.ndarray:
        """Return the steps of each episode and the visible objects of all of them, shape (N, 2), int64."""
        counts = [[file.counts("steps"), file.counts("objects")] for file in self._files.values()]
        return np.concatenate(counts, axis=1, dtype=np.int64).T

    def image_counts(self) -> np.ndarray:
        """Return the number of images of each episode, shape (N,), int64."""
        return np.concatenate([file.counts("images") for file in self._files.values()], dtype=np.int64)


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
        DatasetError: A shard is damaged.
    """
    if boxes is not None and kind == "frames":
        raise DatasetError(f"boxes are those of {boxes.name}, but whole frames have none; leave them out.")
    variant = Variant(boxes, appearance)
    if check_object_cache(dataset, kind, variant, folder=folder):
        target, entries = _cache_folder(dataset, kind, folder, variant.name), dataset.manifest["shards"]
        with folder_lock(target, timeout_s=timeout_s):
            _, missing = _open_files(target, dataset, kind, variant.name)
            total = sum(index.num_rows for index in missing.values())
            work = [
                (dataset.path / name, entries[name], index, target / name)
                for name, index in sorted(missing.items(), key=lambda entry: -entry[1].num_rows)
            ]
            job = partial(_write, kind=kind, variant=variant)
            watch = report and (lambda done: report(done, total, ""))
            try:
                for _ in imap_unordered(job, work, workers, report=watch):
                    pass  # the result of a job is its file
            finally:
                _extractor.cache_clear()  # where it was made here
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
    if not _open_files(target, dataset, kind, variant.name)[1]:
        return False
    try:
        target.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=target).close()
    except OSError as error:
        raise DatasetError(
            f"cannot write the object cache to {target}: {error.strerror}. Name another folder: "
            "--object-cache of `openvima train`, --out of `openvima data preprocess`."
        ) from None
    return True


def _cache_folder(dataset: Dataset, kind: InputKind, folder: str | Path | None, variant: str) -> Path:
    if kind not in KINDS:
        raise DatasetError(unknown_name("kind of object cache", kind, KINDS))
    parts = (kind, f"v{CACHE_VERSION}", *((variant,) if variant else ()))
    return (as_path(folder) if folder else dataset.path / CACHE_FOLDER) / "-".join(parts)


def _open_files(
    folder: Path, dataset: Dataset, kind: InputKind, variant: str
) -> tuple[dict[str, CacheFile], dict[str, pa.Table]]:
    """Open the file of each shard; return the parts of the index for which there is none that fits.

    A shard has one task, so that the data set has all of its rows or none.
    """
    files, missing = {}, {}
    for name, index in split_index(dataset.index).items():
        try:
            files[name] = CacheFile(folder / name, kind, joint_hash(index), variant)
        except DatasetError:
            missing[name] = index
    return files, missing


def _write(
    work: tuple[Path, Mapping[str, Any], pa.Table, Path],
    count: Callable[[int], None],
    *,
    kind: InputKind,
    variant: Variant,
) -> None:
    """Write a file for a shard, given with its part of the index."""
    path, written, index, target = work
    shard = Shard(path, written)
    extractor = _extractor(variant.boxes) if variant.boxes else None
    kept = split_hashes(index, "boxes/") < (variant.boxes.fraction if variant.boxes else 1.0)
    episodes = []
    for row, entry in enumerate(index.to_pylist()):
        task, seed = entry["task"], entry["seed"]
        is_unknown = variant.appearance is not None and task == COMPOSED  # its prompt is not sampled
        if is_unknown or not kept[row]:
            episodes.append((task, seed))
        else:
            shard.check(row, *(entry[name] for name in SPAN))
            demo = shard[row]
            if variant.appearance is not None:
                demo = with_random_appearance(demo, shard.info, variant.appearance)
            episode = preprocess(demo, kind, extractor)
            # Random appearances have no names.
            episodes.append(episode if variant.appearance is None else replace(episode, descriptions={}))
        count(row + 1)
    write_cache_file(target, episodes, kind, joint_hash(index), variant.name)


@lru_cache(maxsize=1)
def _extractor(boxes: Boxes) -> ObjectExtractor:
    """Make an extractor once in this process, for all shards."""
    return boxes.make()
