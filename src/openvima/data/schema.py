"""The columns of a shard: one row, and one record batch, an episode.

Images are raw bytes (rows, columns, channels); Arrow compresses the buffers. Lists over steps have T + 1
entries for what is seen (before the first step and after each) and T for what is done. Shapes that Arrow does
not know are written beside the columns, under the key "shape". Lists are empty where nothing is known: poses
and joint paths of imported demonstrations, images where they are redrawn on reading.
"""

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
NUMBERS = frozenset({*ARRAYS, "joint_paths"}) - IMAGES


def _list(dtype: pa.DataType, length: int = -1) -> pa.DataType:
    """Lists without gaps, of one length if it is given."""
    return pa.list_(pa.field("item", dtype, nullable=False), length)


def _field(name: str, dtype: pa.DataType, shape: str = "") -> pa.Field:
    return pa.field(name, dtype, nullable=False, metadata={"shape": shape} if shape else None)


def _arrays(name: str) -> pa.Field:
    """A column of `ARRAYS`."""
    dtype, shape = ARRAYS[name]
    written = "steps + 1,objects,7" if name == "poses" else ",".join(map(str, shape))
    numbers = _list(pa.from_numpy_dtype(dtype), prod(shape))
    return _field(name, _list(numbers), "" if name in ACTION_SHAPES else written)


RECORD = pa.struct([_field("id", pa.int32()), _field("object", pa.string()), _field("texture", pa.string())])
OBJECT = pa.struct(
    [
        *RECORD,
        _field("size", _list(pa.float64(), 3)),
        _field("scale", _list(pa.float64(), 3)),
        _field("fixed", pa.bool_()),
    ]
)
PROMPT_IMAGE = pa.struct(
    [
        _field("name", pa.string()),
        _field("kind", pa.string()),
        _field("objects", _list(RECORD)),
    ]
)
SKIPPED = pa.struct([_field("seed", pa.int64()), _field("kind", pa.string()), _field("reason", pa.string())])

COLUMNS = pa.schema(
    [
        _field("task", pa.string()),
        _field("level", pa.string()),
        _field("domain", pa.string()),
        _field("seed", pa.int64()),
        _field("steps", pa.int32()),
        _field("max_steps", pa.int32()),
        _field("redraws", pa.int32()),
        _field("content_hash", pa.string()),
        _field("skipped", _list(SKIPPED)),  # seeds tried since the row before, and why they were not kept
        _field("success", pa.bool_()),
        _field("failure", pa.bool_()),
        _field("reason", pa.string()),
        _field("end_effector", pa.string()),
        _field("objects", _list(OBJECT)),
        *map(_arrays, ("poses", *ACTION_SHAPES)),
        _field("pick_ids", _list(pa.int32())),
        _field("place_ids", _list(pa.int32())),
        _field("joint_paths", _list(_list(_list(pa.float32(), 6)))),  # radians
        _field("prompt", pa.string()),
        _field("prompt_images", _list(PROMPT_IMAGE)),
        *map(_arrays, filter(IMAGES.__contains__, ARRAYS)),
    ]
)
