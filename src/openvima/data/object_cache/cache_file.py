"""One file of the object cache: a head, and one record per episode, memory-mapped.

    preamble   PREAMBLE
    head       JSON, with the different descriptions; the index, an `Entry` per episode; the different prompts
    records    tables of `OBJECT`, `STEP` and `PROMPT_IMAGE`, then the images; each at a multiple of 64 bytes

The head has a checksum, compared when the file is opened; the index holds those of each record, compared at
every read: of its tables, of the images that prompt and observations show, and of the others. These come
last: a batch without augmentation does without them. Nothing is compressed: a batch consists of copies of
contiguous bytes.
"""

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from xxhash import xxh3_64_intdigest

from openvima.atomic_io import atomic_write
from openvima.data.checksums import mapped
from openvima.data.object_cache.episode import ACTION_PARTS, FalsePositives, PreprocessedEpisode
from openvima.data.shard import ODD_ERRORS
from openvima.errors import ShardError
from openvima.perception.preprocessing import (
    IMAGE_SIZES,
    KINDS,
    InputKind,
    ObjectTable,
    PreprocessedPrompt,
    image_names,
)
from openvima.scene import ACTION_SHAPES

CACHE_VERSION = 6  # grows whenever the same demonstration gives another record
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
PROMPT_IMAGE = np.dtype([("description", "<u4"), ("num_objects", "<i2"), ("is_scene", "?")], align=True)


class Entry(NamedTuple):
    """Where the record of an episode lies, and what its tables count.

    Args:
        start: First byte of the record in the file.
        images_start: First byte of its images.
        tables_checksum: xxh3 of the bytes up to there, 64 bits.
        inputs_checksum: The same of its first images, which prompt and observations show.
        others_checksum: The same of its other images: false detections, and what is seen after the last step.
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
        num_inputs: Images that prompt and observations show.
        most_in_prompt: Most objects in a prompt image.
        most_in_view: Most objects in an observation, that after the last step included.
    """

    start: int
    images_start: int
    tables_checksum: int
    inputs_checksum: int
    others_checksum: int
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
    num_inputs: int
    most_in_prompt: int
    most_in_view: int


_WIDE = ("start", "images_start", "seed", "text_start")
_CODES = ["Q" if name.endswith("checksum") else "q" if name in _WIDE else "i" for name in Entry._fields]
_ENTRY = struct.Struct("<" + "".join(_CODES))
INDEX = np.dtype([(name, f"<{code}") for name, code in zip(Entry._fields, _CODES, strict=True)])


def write_cache_file(
    path: Path, episodes: Sequence[PreprocessedEpisode], kind: InputKind, source: str, variant: str = ""
) -> None:
    """Write one file.

    Args:
        path: The file; it bears its name only once it is whole.
        episodes: What to write.
        kind: What their images show.
        source: Content hash of the demonstrations that they were made of.
        variant: How the episodes differ from these, as in `Variant`; empty if they do not.
    """
    tasks = sorted({episode.task for episode in episodes})
    descriptions = ["", *sorted({text for episode in episodes for text in episode.descriptions.values()})]
    about = {"kind": kind, "source": source, "variant": variant, "tasks": tasks, "rows": len(episodes)}
    about["descriptions"] = descriptions  # the first is that of images without any
    heading = json.dumps({"version": CACHE_VERSION, **about}).encode()
    texts, places = b"", {}
    for text in dict.fromkeys(episode.prompt.text for episode in episodes):
        places[text] = len(texts), len(text.encode())
        texts += text.encode()
    texts_start = PREAMBLE.itemsize + len(heading) + len(episodes) * INDEX.itemsize
    head_bytes = start = _aligned(texts_start + len(texts))
    numbers = {text: number for number, text in enumerate(descriptions)}
    tables, entries = [_tables_of(episode, numbers) for episode in episodes], []
    for episode, content in zip(episodes, tables, strict=True):
        prompt, images = episode.prompt, np.ascontiguousarray(episode.images)
        num_inputs = max(int(table.crop_index.max(initial=0)) for table in (prompt.objects, episode.objects))
        text_start, text_bytes = places[prompt.text]
        entries.append(
            Entry(
                start=start,
                images_start=start + len(content),
                tables_checksum=xxh3_64_intdigest(content),
                inputs_checksum=xxh3_64_intdigest(images[:num_inputs].data),
                others_checksum=xxh3_64_intdigest(images[num_inputs:].data),
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
                num_inputs=num_inputs,
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
            self.content = mapped(path).cast("B")
            about = self._read_head()
        except (*ODD_ERRORS, AttributeError, RecursionError) as error:
            raise ShardError(_unfit(path, str(error).splitlines()[0] if str(error) else "empty")) from None
        self.kind: InputKind = about["kind"]
        self.source: str = about["source"]
        self.variant: str = about["variant"]
        self.tasks: list[str] = about["tasks"]
        self.descriptions: list[str] = about["descriptions"]
        height, width = IMAGE_SIZES[self.kind]
        self.image_shape, self.image_bytes = (3, height, width), 3 * height * width
        self._texts: dict[tuple[int, int], str] = {}
        ends = self.index["images_start"] + self.index["num_images"] * self.image_bytes
        num_bytes = _aligned(int(ends.max(initial=len(self.content) if not len(self) else 0)))
        if len(self.content) != num_bytes:
            raise ShardError(_unfit(path, f"it has {len(self.content):,} of {num_bytes:,} bytes"))
        tasks_there = (self.index["task"] >= 0) & (self.index["task"] < len(self.tasks))
        if not (_fits(self.index, len(self.content)) and tasks_there.all()):
            raise ShardError(_unfit(path, "its index counts more than its records hold"))

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, row: int) -> PreprocessedEpisode:
        entry = Entry(*_ENTRY.unpack(self.entry_bytes(row)))
        tables = self.content[entry.start : entry.images_start]
        self.check(row, tables, entry.tables_checksum)
        first, second = entry.num_prompt_objects, entry.num_prompt_objects + entry.num_objects
        objects = np.frombuffer(tables, OBJECT, second + entry.num_final_objects)
        offset = objects.nbytes
        steps = np.frombuffer(tables, STEP, entry.num_steps, offset)
        offset += steps.nbytes
        prompt_images = np.frombuffer(tables, PROMPT_IMAGE, entry.num_prompt_images, offset)
        text = self.text(entry.text_start, entry.text_bytes)
        return PreprocessedEpisode(
            task=self.tasks[entry.task],
            seed=entry.seed,
            end_effector=entry.end_effector,
            prompt=PreprocessedPrompt(
                text,
                object_table(objects[:first]),
                prompt_images["num_objects"],
                prompt_images["is_scene"],
            ),
            objects=object_table(objects[first:second]),
            objects_per_step=steps["objects_per_step"],
            pick_ids=steps["pick_ids"],
            place_ids=steps["place_ids"],
            false_positives=FalsePositives(steps["false_positive_crop_index"], steps["false_positive_boxes"]),
            final=object_table(objects[second:]),
            actions=steps["actions"],
            images=self.images(row),
            descriptions=self._descriptions_of(row, text, prompt_images["description"].tolist()),
        )

    def _descriptions_of(self, row: int, text: str, numbers: Sequence[int]) -> dict[str, str]:
        """Return the descriptions of a prompt's images by name."""
        if max(numbers, default=0) >= len(self.descriptions):
            raise ShardError(_unfit(self.path, f"record {row} of {len(self)} counts more descriptions"))
        pairs = zip(image_names(text), numbers, strict=False)
        return {name: self.descriptions[number] for name, number in pairs if number}

    def entry_bytes(self, row: int) -> memoryview:
        """Return the entry of an episode as it is stored."""
        return self._index_bytes[row * _ENTRY.size : (row + 1) * _ENTRY.size]

    def images(self, row: int) -> np.ndarray:
        """Return the images of one episode, shape (K, 3, height, width), uint8.

        Raises:
            ShardError: They are damaged.
        """
        entry = Entry(*_ENTRY.unpack(self.entry_bytes(row)))
        start, others = entry.images_start, entry.images_start + entry.num_inputs * self.image_bytes
        end = start + entry.num_images * self.image_bytes
        self.check(row, self.content[start:others], entry.inputs_checksum)
        self.check(row, self.content[others:end], entry.others_checksum)
        return np.ndarray((entry.num_images, *self.image_shape), np.uint8, self.content, start)

    def check(self, row: int, content: memoryview, checksum: int) -> None:
        """Compare bytes of a record with their checksum.

        Raises:
            ShardError: They are damaged.
        """
        if xxh3_64_intdigest(content) != checksum:
            reason = f"the checksum of record {row} of {len(self)} is wrong"
            raise ShardError(_unfit(self.path, reason))

    def text(self, start: int, num_bytes: int) -> str:
        """Return a prompt's text."""
        key = start, num_bytes
        if key not in self._texts:
            self._texts[key] = str(self.content[start : start + num_bytes], "utf-8")
        return self._texts[key]

    def texts(self) -> set[str]:
        """Return the different prompts."""
        places = np.unique(self.index[["text_start", "text_bytes"]])
        return {self.text(start, size) for start, size in places.tolist()}

    def _read_head(self) -> dict:
        """Map the index, and return what the JSON says."""
        content, size = self.content, PREAMBLE.itemsize
        preamble = np.frombuffer(content[:size], PREAMBLE)
        magic, checksum, head_bytes, json_bytes = preamble[0].item()
        if magic != _MAGIC:
            raise ValueError("it begins with other bytes")
        if xxh3_64_intdigest(content[_HASHED_FROM:head_bytes]) != checksum:
            raise ValueError("the checksum of its index is wrong")
        about = json.loads(bytes(content[size : size + json_bytes]))
        if about.get("version") != CACHE_VERSION:
            raise ValueError(f"it is of version {about.get('version')!r:.20}, not {CACHE_VERSION}")
        if about.get("kind") not in KINDS:
            raise ValueError(f"its kind is {about.get('kind')!r:.80}")
        if missing := sorted({"source", "variant", "tasks", "rows", "descriptions"} - about.keys()):
            raise ValueError(f"its head lacks {', '.join(missing)}")
        texts = about["source"], about["variant"], *about["tasks"], *about["descriptions"]
        if not all(isinstance(text, str) for text in texts):
            raise ValueError("its head holds other values than texts")
        self._index_bytes = content[size + json_bytes :][: about["rows"] * INDEX.itemsize]
        self.index = np.frombuffer(self._index_bytes, INDEX)
        return about


def file_name(shard: str) -> str:
    """Return the name of the cache file of a shard."""
    return str(Path(shard).with_suffix(SUFFIX))


def object_table(rows: np.ndarray) -> ObjectTable:
    """Return rows of `OBJECT` as a table, without a copy."""
    return ObjectTable(rows["ids"], rows["crop_index"], rows["boxes"], rows["grasps"])


def _fits(index: np.ndarray, file_bytes: int) -> bool:
    """Tell whether the tables of each record lie within it; compiled loops read them unchecked."""
    counts = index["num_prompt_objects"], index["num_objects"], index["num_final_objects"]
    counts = *counts, index["num_steps"], index["num_prompt_images"]
    dtypes = OBJECT, OBJECT, OBJECT, STEP, PROMPT_IMAGE
    num_bytes = sum(
        dtype.itemsize * count.astype(np.int64) for dtype, count in zip(dtypes, counts, strict=True)
    )
    start, end = index["start"], index["images_start"]
    has_room = (start >= 0) & (start <= end) & (end <= file_bytes) & (num_bytes <= end - start)
    return bool(all((count >= 0).all() for count in counts) and np.all(has_room))


def _tables_of(episode: PreprocessedEpisode, descriptions: Mapping[str, int]) -> bytes:
    """All tables of a record, with zeros behind them up to where images may begin.

    Args:
        episode: What to write.
        descriptions: Number of each description.
    """
    prompt, false_positives = episode.prompt, episode.false_positives
    steps = np.zeros(episode.num_steps, STEP)
    for name in ("actions", "objects_per_step", "pick_ids", "place_ids"):
        steps[name] = getattr(episode, name)
    steps["false_positive_crop_index"] = false_positives.crop_index
    steps["false_positive_boxes"] = false_positives.boxes
    prompt_images = np.zeros(len(prompt.is_scene), PROMPT_IMAGE)
    prompt_images["num_objects"], prompt_images["is_scene"] = prompt.objects_per_image, prompt.is_scene
    described = [descriptions[episode.descriptions.get(name, "")] for name in prompt.image_names]
    prompt_images["description"] = described
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
