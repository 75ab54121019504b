"""Demonstrations to record batches of one row, and back."""

import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from openvima.data.records import Demonstration, make_columns, planes
from openvima.data.schema import ARRAYS, CODECS, COLUMNS, IMAGES, SCHEMA_VERSION, VIEWS
from openvima.env.config import EnvConfig, without_published
from openvima.errors import DatasetError, unknown_name
from openvima.scene import (
    ACTION_SHAPES,
    Action,
    ObjectRecord,
    Outcome,
    Placement,
    Pose,
    PromptImage,
    RenderedPrompt,
    Scene,
)
from openvima.scene.action import PRIMITIVES
from openvima.tasks.prompts import MULTIMODAL
from openvima.user_code import is_code

_METADATA_KEY = b"openvima"
_MAX_FUNCTION = 200  # characters
_WORD = re.compile(r"\w[\w .+-]{0,100}")
# Texts, records and single numbers, which are made at once: each call into Arrow takes microseconds.
_OTHER_NAMES = [name for name in COLUMNS.names if name not in (*ARRAYS, "joint_paths")]
_OTHERS = pa.struct([COLUMNS.field(name) for name in _OTHER_NAMES])

SkipKind = Literal["failed", "unsolved", "no_action", "not_sampled"]


@dataclass(frozen=True, slots=True)
class Skipped:
    """A seed that gave no demonstration.

    Args:
        seed: The seed.
        kind: "failed" (the oracle spoilt it), "unsolved" (it ran out of steps), "no_action" (it was at a
            loss) or "not_sampled" (the task found no start).
        reason: Details.
    """

    seed: int
    kind: SkipKind
    reason: str


@dataclass(frozen=True, slots=True)
class ShardInfo:
    """What all rows of a shard have in common; written once a file.

    Args:
        task: Name of the task.
        level: one of `openvima.catalog.LEVELS`.
        domain: Domain of the seeds.
        number: Which shard of the task, from 0.
        shard_size: Episodes in a full shard; 0 where shards grow with their number.
        first_seed: First seed of the whole data set.
        assets: Name of the asset pack.
        versions: Package name to version.
        compat: Whether the original benchmark was followed also where it is odd.
        prompts: "multimodal", or what replaces object images in prompts; only then recorded.
        task_options: As in `EnvConfig`; only recorded if there are any.
        control: As in `EnvConfig`; only recorded if it is not "primitives".
        compression: Codec of the buffers, "lz4" or "zstd".
        images: Whether images are stored; without, they are drawn anew on reading.

    Raises:
        DatasetError: There is no such codec.
    """

    task: str
    level: str
    domain: str
    number: int
    shard_size: int
    first_seed: int
    assets: str
    versions: dict[str, str]
    compat: bool = False
    prompts: str = MULTIMODAL
    task_options: str = ""
    control: str = PRIMITIVES
    compression: str = "lz4"
    images: bool = True

    def __post_init__(self) -> None:
        if self.compression not in CODECS:
            raise DatasetError(unknown_name("compression", self.compression, CODECS))

    @property
    def file_name(self) -> str:
        """Name of the shard's file."""
        return f"{self.task}-{self.level}-{self.number:05d}.arrow"

    @property
    def env_config(self) -> EnvConfig:
        """Settings of the environments; assets by their recorded name."""
        return EnvConfig.from_record(asdict(self))

    def of_data_set(self) -> dict[str, Any]:
        """Return the settings and versions that all shards of a data set share."""
        own = ("task", "number", "versions")
        return {name: value for name, value in {**asdict(self), **self.versions}.items() if name not in own}

    def to_metadata(self) -> dict[bytes, bytes]:
        """Return the entry for the file's schema."""
        fields = without_published(asdict(self))
        if not self.task_options:
            fields["difficulty"] = "easy"  # part of schema version 1, whose bytes are published
        text = json.dumps({"schema": SCHEMA_VERSION, **fields}, sort_keys=True)
        return {_METADATA_KEY: text.encode()}

    @staticmethod
    def from_metadata(metadata: Mapping[bytes, bytes] | None) -> "ShardInfo":
        """Read the entry of a file's schema.

        Raises:
            DatasetError: There is none, it is damaged, or of another version.
        """
        try:
            fields = json.loads((metadata or {}).get(_METADATA_KEY, b"{}"))
            written_as = fields.pop("schema", None)
            if written_as != SCHEMA_VERSION:
                found = f"schema version {written_as}" if written_as else "no demonstrations"
                raise DatasetError(f"it holds {found}; this package reads version {SCHEMA_VERSION}.")
            fields.pop("difficulty", None)  # always easy
            info = ShardInfo(**fields)
            for name in ("task", "level", "domain", "assets"):  # of which names of files are made
                value = getattr(info, name)
                if not _WORD.fullmatch(value) and not (name == "assets" and _is_function(value)):
                    raise DatasetError(f"its {name} is {value!r:.80}, which is no plain name.")
        except (UnicodeDecodeError, json.JSONDecodeError, AttributeError, TypeError) as error:
            raise DatasetError(f"what it says of itself is damaged ({error}).") from None
        return info


def _is_function(assets: str) -> bool:
    """Whether assets are named by a function, without a folder."""
    return len(assets) <= _MAX_FUNCTION and is_code(assets) and "/" not in assets and assets.isprintable()


def encode(
    demo: Demonstration, skipped: Sequence[Skipped] = (), *, with_images: bool = True
) -> pa.RecordBatch:
    """Make one row of a demonstration.

    Args:
        demo: The demonstration.
        skipped: Seeds tried just before it in vain.
        with_images: Store what the cameras saw and the prompt shows; the content hash counts them either way.

    Returns:
        A record batch of one row with the columns of `schema.COLUMNS`.
    """
    records, arrays = make_columns(demo)
    made = pa.array([{**records, "skipped": [asdict(each) for each in skipped]}], type=_OTHERS)
    cells = dict(zip(_OTHER_NAMES, made.flatten(), strict=True))
    for name, array in arrays.items():
        rows = array if with_images or name not in IMAGES else array[:0]
        dtype, is_path = COLUMNS.field(name).type, name == "joint_paths"
        item = dtype.value_type.value_type if is_path else dtype.value_type
        items = pa.FixedSizeListArray.from_arrays(rows.reshape(-1), type=item)
        if is_path:  # one for each step
            ends = [0, *itertools.accumulate(map(len, demo.joint_paths))]
            items = _make_lists(items, ends, dtype.value_type)
        cells[name] = _make_lists(items, [0, len(items)], dtype)
    return pa.RecordBatch.from_arrays([cells[name] for name in COLUMNS.names], schema=COLUMNS)


def _make_lists(items: pa.Array, ends: Sequence[int], dtype: pa.ListType) -> pa.ListArray:
    """Lists of the items, each up to where the next begins."""
    return pa.ListArray.from_arrays(pa.array(np.array(ends, np.int32)), items, type=dtype)


def list_rows(numbers: np.ndarray) -> pa.Array:
    """Return numbers of shape (N,) as they are, and those of shape (N, …) as N lists of one length."""
    flat = pa.array(numbers.reshape(-1))
    if numbers.ndim == 1:
        return flat
    return pa.FixedSizeListArray.from_arrays(flat, math.prod(numbers.shape[1:]))


def decode(batch: pa.RecordBatch, info: ShardInfo) -> Demonstration:
    """Make a demonstration of one row.

    Args:
        batch: A record batch of one row, as `encode` gives it.
        info: What the file says about all its rows.

    Returns:
        The demonstration; its images belong to the caller, who may write to them. Where the file stores none,
        its dictionaries of images are empty until `rerender.rerender` fills them.
    """
    row = decode_columns(batch)
    views = VIEWS if info.images else ()
    return Demonstration(
        task=row["task"],
        level=row["level"],
        domain=row["domain"],
        seed=row["seed"],
        num_redraws=row["redraws"],
        max_steps=row["max_steps"],
        prompt=_prompt(row, views),
        rgb={view: planes(row[f"rgb_{view}"]) for view in views},
        segm={view: row[f"segm_{view}"].copy() for view in views},
        end_effector=row["end_effector"],
        actions=decode_actions(row),
        pick_ids=tuple(row["pick_ids"]),
        place_ids=tuple(row["place_ids"]),
        joint_paths=tuple(row["joint_paths"]),
        objects=tuple(_record(entry) for entry in row["objects"]),
        scenes=_scenes(row),
        outcome=Outcome(row["success"], row["failure"], row["reason"]),
        assets=info.assets,
        versions=dict(info.versions),
    )


def decode_columns(batch: pa.RecordBatch) -> dict[str, Any]:
    """Return the values of some columns of one row.

    Args:
        batch: A record batch of one row with any columns of a shard; "steps" among them if "poses" is.

    Returns:
        Column name to value: an array for poses, actions and images (colours last, as they are stored), a
        list of arrays for joint paths, and else what `to_pylist` gives. Arrays are read-only.

    Raises:
        ValueError: Its arrays do not fit together.
    """
    values: dict[str, Any] = {}
    for number, name in enumerate(batch.schema.names):
        column = batch.column(number)
        if name in ARRAYS:
            values[name] = column.values.values.to_numpy().reshape(-1, *ARRAYS[name][1])
        elif name == "joint_paths":
            paths = column.values
            waypoints = paths.values.values.to_numpy().reshape(-1, 6)
            ends = paths.offsets.to_numpy().tolist()
            values[name] = [waypoints[start:end] for start, end in itertools.pairwise(ends)]
        else:
            values[name] = column[0].as_py()
    if len(values.get("poses", ())):
        values["poses"] = values["poses"].reshape(values["steps"] + 1, -1, 7)
    return values


def decode_actions(row: Mapping[str, Any]) -> tuple[Action, ...]:
    """Return the actions of a row, one for each step."""
    columns = [row[name].tolist() for name in ACTION_SHAPES]
    return tuple(
        Action(tuple(pick), tuple(place), tuple(heading), tuple(turned))
        for pick, heading, place, turned in zip(*columns, strict=True)
    )


def _prompt(row: Mapping[str, Any], views: Sequence[str]) -> RenderedPrompt:
    rgb = {view: planes(row[f"prompt_rgb_{view}"]) for view in views}
    images = {}
    for number, entry in enumerate(row["prompt_images"]):
        images[entry["name"]] = PromptImage(
            name=entry["name"],
            kind=entry["kind"],
            rgb={view: rgb[view][number] for view in views},
            segm={view: row[f"prompt_segm_{view}"][number].copy() for view in views},
            objects=tuple(_record(shown) for shown in entry["objects"]),
        )
    return RenderedPrompt(row["prompt"], images)


def _record(entry: Mapping[str, Any]) -> ObjectRecord:
    return ObjectRecord(entry["id"], entry["object"], entry["texture"])


def _scenes(row: Mapping[str, Any]) -> tuple[Scene, ...]:
    objects = [
        (o["id"], o["object"], o["texture"], tuple(o["size"]), o["fixed"], tuple(o["scale"]))
        for o in row["objects"]
    ]
    return tuple(
        Scene(tuple(map(_placement, objects, poses)), row["end_effector"]) for poses in row["poses"].tolist()
    )


def _placement(entry: tuple, pose: list[float]) -> Placement:
    object_id, name, texture, size, fixed, scale = entry
    x, y, z, qx, qy, qz, qw = pose
    return Placement(object_id, name, texture, size, Pose((x, y, z), (qx, qy, qz, qw)), fixed, scale)
