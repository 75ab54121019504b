"""The columns of a shard: one row, and one record batch, an episode.

Images are raw bytes (rows, columns, channels); Arrow compresses the buffers. Lists over steps have T + 1
entries for what is seen (before the first step and after each) and T for what is done. Shapes that Arrow does
not know are written beside the columns, under the key "shape". Lists are empty where nothing is known: poses
and joint paths of imported demonstrations, images where they are redrawn on reading.
"""

from collections.abc import Mapping
from math import prod

import pyarrow as pa

from openvima.scene import ACTION_SHAPES

SCHEMA_VERSION = 2  # grows whenever a column changes its name, type or meaning
VIEWS = ("front", "top")
CODECS = ("lz4", "zstd")
UNKNOWN_ID = -2  # an object that nobody recorded
IMAGE_SHAPE = (128, 256)

# Columns that list arrays of one shape: their dtype and shape. A pose is x, y, z in metres, quaternion xyzw.
ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "poses": ("<f8", (7,)),
    **{name: ("<f4", (width,)) for name, width in ACTION_SHAPES.items()},
    **{
        f"{kind}_{view}": ("u1", (*IMAGE_SHAPE, 3) if kind.endswith("rgb") else IMAGE_SHAPE)
        for kind in ("prompt_rgb", "prompt_segm", "rgb", "segm")
        for view in VIEWS
    },
}
IMAGES = frozenset(name for name, (_, shape) in ARRAYS.items() if shape[:2] == IMAGE_SHAPE)


def _list(dtype: pa.DataType, length: int = -1) -> pa.DataType:
    """Lists without gaps, of one length if it is given."""
    return pa.list_(pa.field("item", dtype, nullable=False), length)


def _fields(types: Mapping[str, pa.DataType]) -> list[pa.Field]:
    return [pa.field(name, dtype, nullable=False) for name, dtype in types.items()]


def _arrays(name: str) -> pa.Field:
    """A column of `ARRAYS`."""
    dtype, shape = ARRAYS[name]
    written = "steps + 1,objects,7" if name == "poses" else ",".join(map(str, shape))
    numbers = _list(pa.from_numpy_dtype(dtype), prod(shape))
    metadata = None if name in ACTION_SHAPES else {"shape": written}
    return pa.field(name, _list(numbers), nullable=False, metadata=metadata)


RECORD = pa.struct(_fields({"id": pa.int32(), "object": pa.string(), "texture": pa.string()}))
_VECTOR = _list(pa.float64(), 3)
OBJECT = pa.struct([*RECORD, *_fields({"size": _VECTOR, "scale": _VECTOR, "fixed": pa.bool_()})])
PROMPT_IMAGE = pa.struct(_fields({"name": pa.string(), "kind": pa.string(), "objects": _list(RECORD)}))
SKIPPED = pa.struct(_fields({"seed": pa.int64(), "kind": pa.string(), "reason": pa.string()}))

COLUMNS = pa.schema(
    [
        *_fields(
            {
                "task": pa.string(),
                "level": pa.string(),
                "domain": pa.string(),
                "seed": pa.int64(),
                "steps": pa.int32(),
                "max_steps": pa.int32(),
                "redraws": pa.int32(),
                "content_hash": pa.string(),
                "skipped": _list(SKIPPED),  # seeds tried since the row before, and why they were not kept
                "success": pa.bool_(),
                "failure": pa.bool_(),
                "reason": pa.string(),
                "end_effector": pa.string(),
                "objects": _list(OBJECT),
            }
        ),
        *map(_arrays, ("poses", *ACTION_SHAPES)),
        *_fields(
            {
                "pick_ids": _list(pa.int32()),
                "place_ids": _list(pa.int32()),
                "joint_paths": _list(_list(_list(pa.float32(), 6))),  # radians
                "prompt": pa.string(),
                "prompt_images": _list(PROMPT_IMAGE),
            }
        ),
        *map(_arrays, filter(IMAGES.__contains__, ARRAYS)),
    ]
)
