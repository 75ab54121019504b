"""Records of the object cache, read several at once and joined table by table."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from openvima.data.object_cache.cache_file import INDEX, OBJECT, PROMPT_IMAGE, STEP, CacheFile, object_table
from openvima.data.object_cache.episode import FalsePositives
from openvima.data.object_cache.episode_batch import EpisodeBatch
from openvima.perception.preprocessing import PreprocessedPrompts

# The tables of a record, in the order in which they are stored.
_TABLES = {
    "num_prompt_objects": OBJECT,
    "num_objects": OBJECT,
    "num_final_objects": OBJECT,
    "num_steps": STEP,
    "num_prompt_images": PROMPT_IMAGE,
}
_WORD_BYTES = 4  # divides the size of each row


def read_records(places: Sequence[tuple[CacheFile, int]]) -> EpisodeBatch:
    """Read the tables of several episodes, their images when these are iterated over.

    Args:
        places: File and row of each.

    Raises:
        ShardError: One is damaged; raised when its tables or its images are read.
    """
    entries = np.frombuffer(b"".join([file.entry_bytes(row) for file, row in places]), INDEX)
    prompt_objects, objects, _, steps, prompt_images = _read_tables(places, entries)
    texts = zip(entries["text_start"].tolist(), entries["text_bytes"].tolist(), strict=True)
    num_images = entries["num_images"].astype(np.int64)
    return EpisodeBatch(
        [file.tasks[task] for (file, _), task in zip(places, entries["task"].tolist(), strict=True)],
        entries["seed"].tolist(),
        entries["end_effector"].astype(np.int64),
        entries["num_steps"].astype(np.int64),
        PreprocessedPrompts(
            [file.text(*text) for (file, _), text in zip(places, texts, strict=True)],
            entries["num_prompt_images"].astype(np.int64),
            object_table(prompt_objects),
            prompt_images["num_objects"],
            prompt_images["is_scene"],
        ),
        object_table(objects),
        steps["objects_per_step"],
        steps["pick_ids"],
        steps["place_ids"],
        FalsePositives(steps["false_positive_crop_index"], steps["false_positive_boxes"]),
        steps["actions"],
        _Images(places, entries),
        num_images,
        np.cumsum(num_images) - num_images,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Images(Iterable[np.ndarray]):
    """The images of some episodes, read when they are asked for."""

    places: Sequence[tuple[CacheFile, int]]
    entries: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of an image."""
        return self.places[0][0].image_shape

    def __iter__(self) -> Iterator[np.ndarray]:
        return (file.images(row) for file, row in self.places)

    def read(self, number: int) -> np.ndarray:
        """Return all images of one episode."""
        file, row = self.places[number]
        return file.images(row)

    def read_first(self, counts: Sequence[int], starts: Sequence[int], stack: np.ndarray) -> None:
        """Copy the first images of each episode to its place; see `StoredImages`."""
        target, size = stack.reshape(-1).data, self.places[0][0].image_bytes
        columns = (self.entries[name].tolist() for name in ("images_start", "num_inputs", "inputs_checksum"))
        for (file, row), count, start, source, num_inputs, checksum in zip(
            self.places, counts, starts, *columns, strict=True
        ):
            copy = target[start * size : (start + count) * size]
            if count == num_inputs:
                # What is checked is the copy, which is in the CPU cache by then.
                copy[:] = file.content[source : source + count * size]
                file.check(row, copy, checksum)
            elif count:
                copy[:] = file.images(row)[:count].reshape(-1).data


def _read_tables(places: Sequence[tuple[CacheFile, int]], entries: np.ndarray) -> list[np.ndarray]:
    """Read the tables of all records and join each kind; those of `_TABLES`, in its order."""
    from openvima.data.kernels import gather  # Numba takes a moment to be imported

    starts, ends = entries["start"], entries["images_start"]
    joined = b"".join(
        [
            file.content[start:end]
            for (file, _), start, end in zip(places, starts.tolist(), ends.tolist(), strict=True)
        ]
    )
    edges = np.cumsum(np.concatenate([[0], ends - starts]))
    content = memoryview(joined)
    for (file, row), (start, end), checksum in zip(
        places, itertools.pairwise(edges.tolist()), entries["tables_checksum"].tolist(), strict=True
    ):
        file.check(row, content[start:end], checksum)
    words, first, tables = np.frombuffer(joined, np.int32), edges[:-1] // _WORD_BYTES, []
    for name, dtype in _TABLES.items():
        counts = entries[name].astype(np.int64)
        sizes = counts * (dtype.itemsize // _WORD_BYTES)
        table = np.empty(counts.sum(), dtype)
        gather(words, first, sizes, table.view(np.int32))
        first = first + sizes
        tables.append(table)
    return tables
