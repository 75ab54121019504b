"""A demonstration as columns: texts, records and arrays in the layout in which shards store them."""

import itertools
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xxhash

from openvima.data.schema import ARRAYS, IMAGE_SHAPE, VIEWS
from openvima.scene import ACTION_SHAPES, ObjectRecord

if TYPE_CHECKING:
    from openvima.data.records import Demonstration

_JSON = json.JSONEncoder(sort_keys=True)


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """A demonstration, column by column; only "skipped" is missing.

    Args:
        records: Column name to what `to_pylist` gives of the column's row, for all that is no array.
        numbers: Column name to numbers, shape (rows, width): poses, the four arrays of the actions, and the
            waypoints of all joint paths, one path after the other.
        path_lengths: Waypoints of each joint path.
        images: Column name to images, uint8: `prompt_rgb_…` and `rgb_…` (N, 128, 256, 3), `prompt_segm_…`
            and `segm_…` (N, 128, 256).
        content_hash: 32 hexadecimal digits that are equal for equal content; docs/format.md derives them.
    """

    records: dict[str, Any]  # Any: texts, numbers, and lists and dictionaries of them
    numbers: dict[str, np.ndarray]
    path_lengths: list[int]
    images: dict[str, np.ndarray]
    content_hash: str


class Scratch:
    """Memory for the images of one episode after the other: fresh memory costs more than filling it."""

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray] = {}

    def images(self, name: str, count: int) -> np.ndarray:
        """Return room for images, valid until the next call.

        Args:
            name: Column that they are for; each has its own memory.
            count: Number of images.

        Returns:
            An array of uint8 with the shape of the column.
        """
        _, shape = ARRAYS[name]
        if name not in self._arrays or count > len(self._arrays[name]):
            self._arrays[name] = np.empty((count, *shape), np.uint8)
        return self._arrays[name][:count]


def columns_of(demo: "Demonstration", scratch: Scratch | None = None) -> Columns:
    """Return the columns of a demonstration.

    Args:
        demo: The demonstration.
        scratch: Memory for its images; None gives them their own.
    """
    records, arrays = _records(demo), _arrays(demo)
    path_lengths = [len(path) for path in demo.joint_paths]
    described = {**records, "assets": demo.assets, "path_lengths": path_lengths}
    digest = xxhash.xxh3_128(_JSON.encode(described).encode())
    images = {}
    for name, array in itertools.chain(arrays.items(), _images(demo, scratch or Scratch())):
        digest.update(array.nbytes.to_bytes(8, "little"))
        digest.update(array.reshape(-1).view(np.uint8).data)  # while it is in the processor's cache
        if name not in arrays:
            images[name] = array
    numbers = {name: array.reshape(-1, array.shape[-1]) for name, array in arrays.items()}
    return Columns(records, numbers, path_lengths, images, digest.hexdigest())


def pixels(planes: np.ndarray | Sequence[np.ndarray], out: np.ndarray) -> np.ndarray:
    """Copy images so that their colours come last.

    Args:
        planes: N images of shape (3, 128, 256), uint8.
        out: Where to, shape (N, 128, 256, 3), uint8, contiguous; also what is returned.
    """
    from openvima.data.kernels import join_colours  # Numba takes a moment to be imported

    for image, joined in zip(planes, out, strict=True):
        join_colours(np.ascontiguousarray(image).reshape(3, -1), joined.reshape(-1))
    return out


def planes(pixels: np.ndarray) -> np.ndarray:
    """Return images with their colours first, as observations have them.

    Args:
        pixels: Shape (N, 128, 256, 3), uint8, contiguous.

    Returns:
        A copy of shape (N, 3, 128, 256), uint8, contiguous.
    """
    from openvima.data.kernels import part_colours

    parted = np.empty((len(pixels), 3, *IMAGE_SHAPE), np.uint8)
    num_pixels = IMAGE_SHAPE[0] * IMAGE_SHAPE[1]
    part_colours(pixels.reshape(-1, 3 * num_pixels), parted.reshape(-1, 3, num_pixels))
    return parted


def _records(demo: "Demonstration") -> dict[str, Any]:  # Any: as in `Columns`
    return {
        "task": demo.task,
        "level": demo.level,
        "domain": demo.domain,
        "seed": demo.seed,
        "steps": demo.num_steps,
        "max_steps": demo.max_steps,
        "redraws": demo.num_redraws,
        "success": demo.outcome.success,
        "failure": demo.outcome.failure,
        "reason": demo.outcome.reason,
        "end_effector": demo.end_effector,
        "objects": _objects(demo),
        "pick_ids": list(demo.pick_ids),
        "place_ids": list(demo.place_ids),
        "prompt": demo.prompt.text,
        "prompt_images": [
            {"name": image.name, "kind": image.kind, "objects": [_record(shown) for shown in image.objects]}
            for image in demo.prompt.images.values()
        ],
    }


def _objects(demo: "Demonstration") -> list[dict[str, object]]:
    records = [_record(record) for record in demo.objects]
    if not demo.scenes:
        unknown = [math.nan] * 3
        return [{**record, "size": unknown, "scale": unknown, "fixed": False} for record in records]
    return [
        {**record, "size": _floats(p.size), "scale": _floats(p.scale), "fixed": p.fixed}
        for record, p in zip(records, demo.scenes[0].placements, strict=True)
    ]


def _record(record: ObjectRecord) -> dict[str, object]:
    return {"id": record.object_id, "object": record.object, "texture": record.texture}


def _floats(values: Sequence[float]) -> list[float]:
    return [float(value) for value in values]  # as text, 1 and 1.0 would differ


def _arrays(demo: "Demonstration") -> dict[str, np.ndarray]:
    poses = [[(*p.pose.position, *p.pose.quaternion) for p in scene.placements] for scene in demo.scenes]
    arrays: dict[str, np.ndarray] = {
        "poses": np.array(poses, "<f8").reshape(len(poses), len(demo.objects), 7)
    }
    for name, width in ACTION_SHAPES.items():
        values = np.array([getattr(action, name) for action in demo.actions], "<f4")
        arrays[name] = values.reshape(-1, width)
    paths = [np.zeros((0, 6), "<f4"), *demo.joint_paths]
    arrays["joint_paths"] = np.concatenate(paths).astype("<f4", copy=False)
    return arrays


def _images(demo: "Demonstration", scratch: Scratch) -> Iterator[tuple[str, np.ndarray]]:
    shown = list(demo.prompt.images.values())
    for view in VIEWS:
        name = f"prompt_rgb_{view}"
        yield name, pixels([image.rgb[view] for image in shown], scratch.images(name, len(shown)))
    for view in VIEWS:
        name = f"prompt_segm_{view}"
        room = scratch.images(name, len(shown))
        yield name, np.stack([image.segm[view] for image in shown], out=room) if shown else room
    for view in VIEWS:
        name = f"rgb_{view}"
        yield name, pixels(demo.rgb[view], scratch.images(name, len(demo.rgb[view])))
    for view in VIEWS:
        yield f"segm_{view}", np.ascontiguousarray(demo.segm[view])
