"""Record batches to demonstrations, or to some of their columns."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa

from openvima.data.encoding import ShardInfo
from openvima.data.image_layout import planes
from openvima.data.records import Demonstration
from openvima.data.schema import ARRAYS, VIEWS
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


def decode(batch: pa.RecordBatch, info: ShardInfo) -> Demonstration:
    """Make a demonstration of one row.

    Args:
        batch: A record batch of one row, as `encode` gives it.
        info: What the file says about all its rows.

    Returns:
        The demonstration; its images belong to the caller, who may write to them. Where the file stores none,
        its dictionaries of images are empty until `rerender.rerendered` fills them.
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
        segm={view: row[f"segm_{view}"] for view in views},
        end_effector=row["end_effector"],
        actions=actions_in(row),
        pick_ids=tuple(row["pick_ids"]),
        place_ids=tuple(row["place_ids"]),
        joint_paths=tuple(row["joint_paths"]),
        objects=tuple(_record(entry) for entry in row["objects"]),
        scenes=_scenes(row),
        outcome=Outcome(row["success"], row["failure"], row["reason"]),
        assets=info.assets,
        versions=dict(info.versions),
    )


def decode_columns(batch: pa.RecordBatch) -> dict[str, Any]:  # Any: one column, one type
    """Return the values of some columns of one row.

    Args:
        batch: A record batch of one row with any columns of a shard; "steps" among them if "poses" is.

    Returns:
        Column name to value: an array for poses, actions and images (colours last, as they are stored), a
        list of arrays for joint paths, and else what `to_pylist` gives.

    Raises:
        ValueError: The batch has not one row, or its arrays do not fit together.
    """
    if batch.num_rows != 1:
        raise ValueError(f"a record has {batch.num_rows} rows, not 1")
    values: dict[str, Any] = {}
    for number, name in enumerate(batch.schema.names):
        column = batch.column(number)
        if name in ARRAYS:
            values[name] = _array_in(column, *ARRAYS[name])
        elif name == "joint_paths":
            values[name] = _paths_in(column)
        else:
            values[name] = column[0].as_py()
    if len(values.get("poses", ())):
        values["poses"] = values["poses"].reshape(values["steps"] + 1, -1, 7)
    return values


def actions_in(row: Mapping[str, Any]) -> tuple[Action, ...]:  # Any: as `decode_columns` gives it
    """Return the actions of a row, one for each step."""
    columns = [row[name].tolist() for name in ACTION_SHAPES]
    return tuple(
        Action(tuple(pick), tuple(place), tuple(heading), tuple(turned))
        for pick, heading, place, turned in zip(*columns, strict=True)
    )


def _array_in(column: pa.ListArray, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """The arrays that a row lists, without a copy: nobody else sees what Arrow has decompressed."""
    buffers = column.buffers()  # Arrow's own ways to the numbers take ten times as long
    start, end = _ends(buffers[1], column.offset, 1)
    return _slice(buffers[-1], dtype, shape, start, end)


def _paths_in(column: pa.ListArray) -> list[np.ndarray]:
    _, outer, _, inner, *_, numbers = column.buffers()
    start, end = _ends(outer, column.offset, 1)
    ends = _ends(inner, start, end - start)
    return [_slice(numbers, "<f4", (6,), *pair) for pair in pairwise(ends)]


def _ends(offsets: pa.Buffer, start: int, count: int) -> list[int]:
    """Where lists begin, and where the last one ends; `count` of them from number `start`."""
    return np.frombuffer(offsets, "<i4", count=count + 1, offset=4 * start).tolist() if count else []


def _slice(buffer: pa.Buffer | None, dtype: str, shape: tuple[int, ...], start: int, end: int) -> np.ndarray:
    if start == end:
        return np.zeros((0, *shape), dtype)
    length = math.prod(shape)
    offset = start * length * np.dtype(dtype).itemsize
    assert buffer is not None  # since it is not empty
    numbers = np.frombuffer(buffer, dtype, count=(end - start) * length, offset=offset)
    return numbers.reshape(end - start, *shape)


def _prompt(row: Mapping[str, Any], views: Sequence[str]) -> RenderedPrompt:  # Any: as above
    rgb = {view: planes(row[f"prompt_rgb_{view}"]) for view in views}
    images = {}
    for number, entry in enumerate(row["prompt_images"]):
        images[entry["name"]] = PromptImage(
            name=entry["name"],
            kind=entry["kind"],
            rgb={view: rgb[view][number] for view in views},
            segm={view: row[f"prompt_segm_{view}"][number] for view in views},
            objects=tuple(_record(shown) for shown in entry["objects"]),
        )
    return RenderedPrompt(row["prompt"], images)


def _record(entry: Mapping[str, Any]) -> ObjectRecord:  # Any: a number and texts
    return ObjectRecord(entry["id"], entry["object"], entry["texture"])


def _scenes(row: Mapping[str, Any]) -> tuple[Scene, ...]:  # Any: as above
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
