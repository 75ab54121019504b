"""Demonstrations to record batches and back."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from openvima.data.records import Demonstration
from openvima.data.schema import CODECS, COLUMNS, IMAGE_SHAPE, JOINTS, POSE, RGB, SCHEMA_VERSION, SEGM, VIEWS
from openvima.errors import ShardError, unknown_name
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

_METADATA_KEY = b"openvima"

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
        level: "train" or "L1" to "L4".
        domain: Domain of the seeds.
        number: Which shard of the task, from 0.
        shard_size: Episodes in a full shard; 0 where shards grow with their number.
        first_seed: First seed of the whole data set.
        assets: Name of the asset pack.
        versions: Package name to version.
        compat: Whether the original benchmark was followed also where it is odd.
        difficulty: "easy", "medium" or "hard".
        compression: Codec of the buffers, "lz4" or "zstd".
        images: Whether images are stored; without, they are drawn anew on reading.

    Raises:
        ShardError: There is no such codec.
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
    difficulty: str = "easy"
    compression: str = "lz4"
    images: bool = True

    def __post_init__(self) -> None:
        if self.compression not in CODECS:
            raise ShardError(unknown_name("compression", self.compression, CODECS))

    def to_metadata(self) -> dict[bytes, bytes]:
        """Return the entry for the file's schema."""
        fields = {name: getattr(self, name) for name in self.__slots__}
        text = json.dumps({"schema": SCHEMA_VERSION, **fields}, sort_keys=True)
        return {_METADATA_KEY: text.encode()}

    @staticmethod
    def from_metadata(metadata: Mapping[bytes, bytes] | None) -> "ShardInfo":
        """Read the entry of a file's schema.

        Raises:
            ShardError: There is none, it is damaged, or of another version.
        """
        try:
            fields = json.loads((metadata or {}).get(_METADATA_KEY, b"{}"))
            written_as = fields.pop("schema", None)
            if written_as is None:
                raise ShardError("it is an Arrow file, but holds no demonstrations of this package.")
            if written_as != SCHEMA_VERSION:
                raise ShardError(f"it has schema version {written_as}; this package reads {SCHEMA_VERSION}.")
            return ShardInfo(**fields)
        except (UnicodeDecodeError, json.JSONDecodeError, AttributeError, TypeError) as error:
            raise ShardError(f"what it says of itself is damaged ({error}).") from None


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
    images = list(demo.prompt.images.values())
    values: dict[str, Any] = {  # Any: one column, one type
        "task": demo.task,
        "level": demo.level,
        "domain": demo.domain,
        "seed": demo.seed,
        "steps": demo.num_steps,
        "max_steps": demo.max_steps,
        "redraws": demo.num_redraws,
        "content_hash": demo.content_hash(),
        "skipped": [{"seed": s.seed, "kind": s.kind, "reason": s.reason} for s in skipped],
        "success": demo.outcome.success,
        "failure": demo.outcome.failure,
        "reason": demo.outcome.reason,
        "end_effector": demo.end_effector,
        "objects": _objects(demo),
        "poses": _rows(POSE, [_pose_row(p.pose) for scene in demo.scenes for p in scene.placements]),
        **{key: [getattr(action, key) for action in demo.actions] for key in ACTION_SHAPES},
        "pick_ids": list(demo.pick_ids),
        "place_ids": list(demo.place_ids),
        "joint_paths": _nested_rows(demo.joint_paths),
        "prompt": demo.prompt.text,
        "prompt_images": [_prompt_image(image) for image in images],
    }
    drawn, seen = (images, slice(None)) if with_images else ([], slice(0))
    for view in VIEWS:
        values[f"prompt_rgb_{view}"] = _rows(RGB, [np.moveaxis(image.rgb[view], 0, -1) for image in drawn])
        values[f"prompt_segm_{view}"] = _rows(SEGM, [image.segm[view] for image in drawn])
        values[f"rgb_{view}"] = _rows(RGB, np.moveaxis(demo.rgb[view][seen], 1, -1))
        values[f"segm_{view}"] = _rows(SEGM, demo.segm[view][seen])
    return pa.record_batch([_column(field, values[field.name]) for field in COLUMNS], schema=COLUMNS)


def decode(batch: pa.RecordBatch, info: ShardInfo) -> Demonstration:
    """Make a demonstration of one row.

    Args:
        batch: A record batch of one row, as `encode` gives it.
        info: What the file says about all its rows.

    Returns:
        The demonstration; its images are writable copies. Where the file stores none, its dictionaries of
        images are empty until `redrawing.redrawn` fills them.
    """
    views = VIEWS if info.images else ()
    rgb = {view: np.moveaxis(_images(batch, f"rgb_{view}", 3), -1, 1) for view in views}
    segm = {view: _images(batch, f"segm_{view}") for view in views}
    row = {name: batch.column(name)[0] for name in batch.schema.names}
    return Demonstration(
        task=row["task"].as_py(),
        level=row["level"].as_py(),
        domain=row["domain"].as_py(),
        seed=row["seed"].as_py(),
        num_redraws=row["redraws"].as_py(),
        max_steps=row["max_steps"].as_py(),
        prompt=_decode_prompt(batch, views),
        rgb=rgb,
        segm=segm,
        end_effector=row["end_effector"].as_py(),
        actions=_decode_actions(batch),
        pick_ids=tuple(row["pick_ids"].as_py()),
        place_ids=tuple(row["place_ids"].as_py()),
        joint_paths=tuple(_array(path.values, (-1, 6)) for path in row["joint_paths"]),
        objects=_decode_records(batch),
        scenes=_decode_scenes(batch),
        outcome=Outcome(row["success"].as_py(), row["failure"].as_py(), row["reason"].as_py()),
        assets=info.assets,
        versions=dict(info.versions),
    )


def _column(field: pa.Field, value: object) -> pa.Array:
    return value if isinstance(value, pa.Array) else pa.array([value], type=field.type)


def _rows(dtype: pa.FixedSizeListType, rows: Iterable[object]) -> pa.ListArray:
    """A column of one cell that lists arrays of the same length."""
    stacked = np.ascontiguousarray(rows if isinstance(rows, np.ndarray) else list(rows))
    flat = pa.array(stacked.reshape(-1).astype(dtype.value_type.to_pandas_dtype(), copy=False))
    items = pa.FixedSizeListArray.from_arrays(flat, type=dtype)
    return pa.ListArray.from_arrays(pa.array([0, len(items)], pa.int32()), items, type=_list_type(dtype))


def _nested_rows(paths: Sequence[np.ndarray]) -> pa.ListArray:
    """A column of one cell that lists, for each step, the waypoints of the arm."""
    joined = np.concatenate([np.zeros((0, 6), np.float32), *paths])
    waypoints = _rows(JOINTS, joined)
    ends = np.cumsum([0, *(len(path) for path in paths)])
    steps = pa.ListArray.from_arrays(
        pa.array(ends, pa.int32()), waypoints.values, type=COLUMNS.field("joint_paths").type.value_type
    )
    return pa.ListArray.from_arrays(
        pa.array([0, len(paths)], pa.int32()), steps, type=COLUMNS.field("joint_paths").type
    )


def _list_type(dtype: pa.DataType) -> pa.ListType:
    return pa.list_(pa.field("item", dtype, nullable=False))


def _objects(demo: Demonstration) -> list[dict[str, object]]:
    if not demo.scenes:
        unknown = {"size": (math.nan,) * 3, "scale": (math.nan,) * 3, "fixed": False}
        return [{**_record(record), **unknown} for record in demo.objects]
    return [
        {**_record(record), "size": placement.size, "scale": placement.scale, "fixed": placement.fixed}
        for record, placement in zip(demo.objects, demo.scenes[0].placements, strict=True)
    ]


def _record(record: ObjectRecord) -> dict[str, object]:
    return {"id": record.object_id, "object": record.object, "texture": record.texture}


def _pose_row(pose: Pose) -> tuple[float, ...]:
    return (*pose.position, *pose.quaternion)


def _prompt_image(image: PromptImage) -> dict[str, object]:
    return {"name": image.name, "kind": image.kind, "objects": [_record(o) for o in image.objects]}


def _array(items: pa.Array, shape: tuple[int, ...]) -> np.ndarray:
    """A writable copy of a list of fixed-size lists."""
    return np.array(items.flatten().to_numpy(zero_copy_only=True)).reshape(shape)


def _images(batch: pa.RecordBatch, column: str, num_channels: int = 0) -> np.ndarray:
    channels = (num_channels,) if num_channels else ()
    return _array(batch.column(column)[0].values, (-1, *IMAGE_SHAPE, *channels))


def _decode_prompt(batch: pa.RecordBatch, views: Sequence[str]) -> RenderedPrompt:
    rgb = {view: np.moveaxis(_images(batch, f"prompt_rgb_{view}", 3), -1, 1) for view in views}
    segm = {view: _images(batch, f"prompt_segm_{view}") for view in views}
    images = {}
    for index, entry in enumerate(batch.column("prompt_images")[0].as_py()):
        images[entry["name"]] = PromptImage(
            name=entry["name"],
            kind=entry["kind"],
            rgb={view: rgb[view][index] for view in views},
            segm={view: segm[view][index] for view in views},
            objects=tuple(ObjectRecord(o["id"], o["object"], o["texture"]) for o in entry["objects"]),
        )
    return RenderedPrompt(batch.column("prompt")[0].as_py(), images)


def _decode_actions(batch: pa.RecordBatch) -> tuple[Action, ...]:
    columns = {key: batch.column(key)[0].as_py() for key in ACTION_SHAPES}
    num_steps = len(columns["pose0_position"])
    return tuple(
        Action(**{key: tuple(values[step]) for key, values in columns.items()}) for step in range(num_steps)
    )


def _decode_records(batch: pa.RecordBatch) -> tuple[ObjectRecord, ...]:
    entries = batch.column("objects")[0].as_py()
    return tuple(ObjectRecord(entry["id"], entry["object"], entry["texture"]) for entry in entries)


def _decode_scenes(batch: pa.RecordBatch) -> tuple[Scene, ...]:
    objects = batch.column("objects")[0].as_py()
    poses = _array(batch.column("poses")[0].values, (-1, len(objects), 7)).tolist()
    end_effector = batch.column("end_effector")[0].as_py()
    return tuple(
        Scene(tuple(_placement(o, row) for o, row in zip(objects, rows, strict=True)), end_effector)
        for rows in poses
    )


def _placement(entry: dict, row: list[float]) -> Placement:
    x, y, z, qx, qy, qz, qw = row
    return Placement(
        id=entry["id"],
        object=entry["object"],
        texture=entry["texture"],
        size=tuple(entry["size"]),
        pose=Pose((x, y, z), (qx, qy, qz, qw)),
        fixed=entry["fixed"],
        scale=tuple(entry["scale"]),
    )
