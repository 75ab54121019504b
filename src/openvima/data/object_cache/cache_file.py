"""One file of the object cache: a head, and one record per episode, memory-mapped.

    preamble   PREAMBLE
    head       JSON; the index, an `Entry` per episode; the different prompt texts
    records    tables of `OBJECT`, `STEP` and `PROMPT_IMAGE`, then the images; each at a multiple of 64 bytes

The head has a checksum, compared when the file is opened; the index holds those of the tables and of the
images of each record, compared at every read. Nothing is compressed: a batch consists of copies of contiguous
bytes.
"""

import json
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from xxhash import xxh3_64_intdigest

from openvima.atomic_io import atomic_write
from openvima.data.checksums import mapped
from openvima.data.object_cache.episode import ACTION_PARTS, FalsePositives, PreprocessedEpisode
from openvima.data.object_cache.episode_batch import EpisodeBatch
from openvima.data.shard import ODD_ERRORS
from openvima.errors import ShardError
from openvima.perception.preprocessing import (
    IMAGE_SIZES,
    KINDS,
    InputKind,
    ObjectTable,
    PreprocessedPrompt,
    PreprocessedPrompts,
)
from openvima.scene import ACTION_SHAPES

CACHE_VERSION = 4  # grows whenever the same demonstration gives another record
SUFFIX = ".cache"
_ALIGNMENT = 64
_MAGIC = b"ovcache\n"
_HASHED_FROM = 16  # first byte that the checksum of the head covers

PREAMBLE = np.dtype([("magic", "S8"), ("checksum", "<u8"), ("head_bytes", "<i8"), ("json_bytes", "<i8")])
# View axis: front, then top. Padding bytes are zero.
OBJECT = np.dtype(
    [("crop_index", "<i4", 2), ("boxes", "<i2", (2, 4)), ("grasps", "<i2", (2, 2)), ("ids", "<i2")],
    align=True,
)
STEP = np.dtype(
    [
        ("actions", "<f4", sum(ACTION_SHAPES[part] for part in ACTION_PARTS)),
        ("false_positive_crop_index", "<i4", 2),
        ("false_positive_boxes", "<i2", (2, 4)),
        ("objects_per_step", "<i2"),
        ("pick_ids", "<i2"),
        ("place_ids", "<i2"),
    ],
    align=True,
)
PROMPT_IMAGE = np.dtype([("num_objects", "<i2"), ("is_scene", "?")], align=True)
_OBJECT_BYTES, _STEP_BYTES, _PROMPT_IMAGE_BYTES = OBJECT.itemsize, STEP.itemsize, PROMPT_IMAGE.itemsize


class Entry(NamedTuple):
    """Where the record of an episode lies, and what its tables count.

    Args:
        start: First byte of the record in the file.
        images_start: First byte of its images.
        tables_checksum: xxh3 of the bytes up to there, 64 bits.
        images_checksum: The same of its images.
        seed: Number of the episode.
        text_start: First byte of the prompt's text in the file, UTF-8.
        text_bytes: Length of that.
        task: Number of the task in the list of the head.
        end_effector: 0 suction cup, 1 spatula.
        num_prompt_objects: Rows of the first table, in `OBJECT`.
        num_objects: Rows of the second, the same for all observations.
        num_final_objects: Rows of the third, the same after the last step.
        num_steps: Rows of the fourth, in `STEP`.
        num_prompt_images: Rows of the fifth, in `PROMPT_IMAGE`.
        num_images: Images.
        most_in_prompt: Most objects in a prompt image.
        most_in_view: Most objects in an observation, that after the last step included.
    """

    start: int
    images_start: int
    tables_checksum: int
    images_checksum: int
    seed: int
    text_start: int
    text_bytes: int
    task: int
    end_effector: int
    num_prompt_objects: int
    num_objects: int
    num_final_objects: int
    num_steps: int
    num_prompt_images: int
    num_images: int
    most_in_prompt: int
    most_in_view: int


_WIDE = ("start", "images_start", "seed", "text_start")
_CODES = ["Q" if name.endswith("checksum") else "q" if name in _WIDE else "i" for name in Entry._fields]
_ENTRY = struct.Struct("<" + "".join(_CODES))
INDEX = np.dtype([(name, f"<{code}") for name, code in zip(Entry._fields, _CODES, strict=True)])


class Record(NamedTuple):
    """The tables of one episode as they are stored, and its entry in the index."""

    entry: Entry
    task: str
    text: str
    prompt_objects: memoryview
    objects: memoryview
    final_objects: memoryview
    steps: memoryview
    prompt_images: memoryview


def write_cache_file(
    path: Path, episodes: Sequence[PreprocessedEpisode], kind: InputKind, source: str, boxes: str = ""
) -> None:
    """Write one file.

    Args:
        path: The file; it bears its name only once it is whole.
        episodes: What to write.
        kind: What their images show.
        source: Content hash of the demonstrations that they were made of.
        boxes: Name of the extractor of the objects; empty for the segmentation.
    """
    tasks = sorted({episode.task for episode in episodes})
    about = {"kind": kind, "source": source, "boxes": boxes, "tasks": tasks, "rows": len(episodes)}
    heading = json.dumps({"version": CACHE_VERSION, **about}).encode()
    texts, places = b"", {}
    for text in dict.fromkeys(episode.prompt.text for episode in episodes):
        places[text] = len(texts), len(text.encode())
        texts += text.encode()
    texts_start = PREAMBLE.itemsize + len(heading) + len(episodes) * INDEX.itemsize
    head_bytes = start = _aligned(texts_start + len(texts))
    tables, entries = [_tables_of(episode) for episode in episodes], []
    for episode, content in zip(episodes, tables, strict=True):
        prompt, images = episode.prompt, np.ascontiguousarray(episode.images)
        text_start, text_bytes = places[prompt.text]
        entries.append(
            Entry(
                start=start,
                images_start=start + len(content),
                tables_checksum=xxh3_64_intdigest(content),
                images_checksum=xxh3_64_intdigest(images.data),
                seed=episode.seed,
                text_start=texts_start + text_start,
                text_bytes=text_bytes,
                task=tasks.index(episode.task),
                end_effector=episode.end_effector,
                num_prompt_objects=len(prompt.objects),
                num_objects=len(episode.objects),
                num_final_objects=len(episode.final),
                num_steps=episode.num_steps,
                num_prompt_images=len(prompt.is_scene),
                num_images=len(images),
                most_in_prompt=int(prompt.objects_per_image.max(initial=0)),
                most_in_view=int(episode.objects_per_step.max(initial=len(episode.final))),
            )
        )
        start = _aligned(start + len(content) + images.nbytes)
    preamble = np.array((_MAGIC, 0, head_bytes, len(heading)), PREAMBLE)
    head = b"".join([preamble.tobytes(), heading, np.array(entries, INDEX).tobytes(), texts])
    head = head.ljust(head_bytes, b"\0")
    preamble["checksum"] = xxh3_64_intdigest(head[_HASHED_FROM:])
    with atomic_write(path) as file:
        file.write(preamble.tobytes() + head[PREAMBLE.itemsize :])
        for episode, content in zip(episodes, tables, strict=True):
            file.write(content)
            file.write(np.ascontiguousarray(episode.images).data)
            file.write(bytes(_aligned(file.tell()) - file.tell()))


class CacheFile:
    """Reads one file of the object cache, memory-mapped.

    Args:
        path: The file.

    Raises:
        ShardError: It is missing, damaged, or holds something else.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._content = mapped(path)
            about = self._read_head()
        except ODD_ERRORS as error:
            raise ShardError(_unfit(path, str(error).splitlines()[0] if str(error) else "empty")) from None
        self.kind: InputKind = about["kind"]
        self.source: str = about["source"]
        self.boxes: str = about["boxes"]
        self._tasks: list[str] = about["tasks"]
        height, width = IMAGE_SIZES[self.kind]
        self._image_shape, self._image_bytes = (3, height, width), 3 * height * width
        ends = self.index["images_start"] + self.index["num_images"] * self._image_bytes
        num_bytes = _aligned(int(ends.max(initial=len(self._content) if not len(self) else 0)))
        if len(self._content) != num_bytes:
            raise ShardError(_unfit(path, f"it has {len(self._content):,} of {num_bytes:,} bytes"))

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, row: int) -> PreprocessedEpisode:
        record = self.read(row)
        steps = np.frombuffer(record.steps, STEP)
        prompt_images = np.frombuffer(record.prompt_images, PROMPT_IMAGE)
        return PreprocessedEpisode(
            task=record.task,
            seed=record.entry.seed,
            end_effector=record.entry.end_effector,
            prompt=PreprocessedPrompt(
                record.text,
                object_table(record.prompt_objects),
                prompt_images["num_objects"],
                prompt_images["is_scene"],
            ),
            objects=object_table(record.objects),
            objects_per_step=steps["objects_per_step"],
            pick_ids=steps["pick_ids"],
            place_ids=steps["place_ids"],
            false_positives=FalsePositives(steps["false_positive_crop_index"], steps["false_positive_boxes"]),
            final=object_table(record.final_objects),
            actions=steps["actions"],
            images=self.images(row, record.entry),
        )

    def read(self, row: int) -> Record:
        """Read the tables of one episode as they are stored.

        Raises:
            ShardError: They are damaged.
        """
        entry, content = Entry(*_ENTRY.unpack_from(self._index_bytes, row * _ENTRY.size)), self._content
        prompt_objects = entry.start
        if xxh3_64_intdigest(content[prompt_objects : entry.images_start]) != entry.tables_checksum:
            raise self._damaged(row)
        objects = prompt_objects + entry.num_prompt_objects * _OBJECT_BYTES
        final_objects = objects + entry.num_objects * _OBJECT_BYTES
        steps = final_objects + entry.num_final_objects * _OBJECT_BYTES
        prompt_images = steps + entry.num_steps * _STEP_BYTES
        return Record(
            entry,
            self._tasks[entry.task],
            str(content[entry.text_start : entry.text_start + entry.text_bytes], "utf-8"),
            content[prompt_objects:objects],
            content[objects:final_objects],
            content[final_objects:steps],
            content[steps:prompt_images],
            content[prompt_images : prompt_images + entry.num_prompt_images * _PROMPT_IMAGE_BYTES],
        )

    def images(self, row: int, entry: Entry) -> np.ndarray:
        """Return the images of one episode, shape (K, 3, height, width), uint8.

        Args:
            row: The episode.
            entry: That of its record.

        Raises:
            ShardError: They are damaged.
        """
        start, end = entry.images_start, entry.images_start + entry.num_images * self._image_bytes
        if xxh3_64_intdigest(self._content[start:end]) != entry.images_checksum:
            raise self._damaged(row)
        return np.ndarray((entry.num_images, *self._image_shape), np.uint8, self._content, start)

    def _damaged(self, row: int) -> ShardError:
        return ShardError(_unfit(self.path, f"the checksum of record {row} of {len(self)} is wrong"))

    def texts(self) -> set[str]:
        """Return the different prompts."""
        places = np.unique(self.index[["text_start", "text_bytes"]])
        return {str(self._content[start : start + size], "utf-8") for start, size in places.tolist()}

    def _read_head(self) -> dict:
        """Map the index, and return what the JSON says."""
        content, size = self._content, PREAMBLE.itemsize
        preamble = np.frombuffer(content[:size], PREAMBLE)
        magic, checksum, head_bytes, json_bytes = preamble[0].item()
        if magic != _MAGIC:
            raise ValueError("it begins with other bytes")
        if xxh3_64_intdigest(content[_HASHED_FROM:head_bytes]) != checksum:
            raise ValueError("the checksum of its index is wrong")
        about = json.loads(bytes(content[size : size + json_bytes]))
        if about["version"] != CACHE_VERSION or about["kind"] not in KINDS:
            raise ValueError(f"it is of version {about['version']}, not {CACHE_VERSION}")
        self._index_bytes = content[size + json_bytes :][: about["rows"] * INDEX.itemsize]
        self.index = np.frombuffer(self._index_bytes, INDEX)
        return about


def file_name(shard: str) -> str:
    """Return the name of the cache file of a shard."""
    return str(Path(shard).with_suffix(SUFFIX))


def join_records(records: Sequence[Record], images: Iterable[np.ndarray]) -> EpisodeBatch:
    """Join the episodes of some records, table by table.

    Args:
        records: Their tables.
        images: Their images.
    """
    steps = np.frombuffer(b"".join([record.steps for record in records]), STEP)
    prompt_images = np.frombuffer(b"".join([record.prompt_images for record in records]), PROMPT_IMAGE)
    entries = [record.entry for record in records]
    counts = np.array([entry.num_images for entry in entries])
    return EpisodeBatch(
        [record.task for record in records],
        [entry.seed for entry in entries],
        np.array([entry.end_effector for entry in entries], np.int64),
        np.array([entry.num_steps for entry in entries]),
        PreprocessedPrompts(
            [record.text for record in records],
            np.array([entry.num_prompt_images for entry in entries]),
            object_table(b"".join([record.prompt_objects for record in records])),
            prompt_images["num_objects"],
            prompt_images["is_scene"],
        ),
        object_table(b"".join([record.objects for record in records])),
        steps["objects_per_step"],
        steps["pick_ids"],
        steps["place_ids"],
        FalsePositives(steps["false_positive_crop_index"], steps["false_positive_boxes"]),
        steps["actions"],
        images,
        counts,
        np.cumsum(counts) - counts,
    )


def object_table(content: memoryview | bytes) -> ObjectTable:
    """Return the objects of a stored table, without a copy."""
    rows = np.frombuffer(content, OBJECT)
    return ObjectTable(rows["ids"], rows["crop_index"], rows["boxes"], rows["grasps"])


def _tables_of(episode: PreprocessedEpisode) -> bytes:
    """All tables of a record, with zeros behind them up to where images may begin."""
    prompt, false_positives = episode.prompt, episode.false_positives
    steps = np.zeros(episode.num_steps, STEP)
    for name in ("actions", "objects_per_step", "pick_ids", "place_ids"):
        steps[name] = getattr(episode, name)
    steps["false_positive_crop_index"] = false_positives.crop_index
    steps["false_positive_boxes"] = false_positives.boxes
    prompt_images = np.zeros(len(prompt.is_scene), PROMPT_IMAGE)
    prompt_images["num_objects"], prompt_images["is_scene"] = prompt.objects_per_image, prompt.is_scene
    tables = [_object_rows(table) for table in (prompt.objects, episode.objects, episode.final)]
    content = b"".join(table.tobytes() for table in (*tables, steps, prompt_images))
    return content.ljust(_aligned(len(content)), b"\0")


def _object_rows(table: ObjectTable) -> np.ndarray:
    rows = np.zeros(len(table), OBJECT)
    for name in OBJECT.names or ():
        rows[name] = getattr(table, name)
    return rows


def _aligned(offset: int) -> int:
    return -(-offset // _ALIGNMENT) * _ALIGNMENT


def _unfit(path: Path, reason: str) -> str:
    remedy = "Delete it; `openvima data preprocess` makes it anew"
    return f"{path} is no readable file of the object cache ({reason}). {remedy}."
