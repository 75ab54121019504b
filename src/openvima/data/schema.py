"""The columns of a shard: one row, and one record batch, an episode.

Images are raw bytes (rows, columns, channels); Arrow compresses the buffers. Lists over steps have T + 1
entries for what is seen (before the first step and after each) and T for what is done. Shapes that Arrow does
not know are written beside the columns, under the key "shape". Lists are empty where nothing is known: poses
and joint paths of imported demonstrations, images where they are redrawn on reading.
"""

import pyarrow as pa

from openvima.scene import ACTION_SHAPES

SCHEMA_VERSION = 2  # grows whenever a column changes its name, type or meaning
VIEWS = ("front", "top")
CODECS = ("lz4", "zstd")
UNKNOWN_ID = -2  # an object that nobody recorded
IMAGE_SHAPE = (128, 256)
_NUM_PIXELS = IMAGE_SHAPE[0] * IMAGE_SHAPE[1]


def _fixed(dtype: pa.DataType, length: int) -> pa.DataType:
    return pa.list_(pa.field("item", dtype, nullable=False), length)


def _list(dtype: pa.DataType) -> pa.DataType:
    return pa.list_(pa.field("item", dtype, nullable=False))


def _field(name: str, dtype: pa.DataType, shape: str = "") -> pa.Field:
    return pa.field(name, dtype, nullable=False, metadata={"shape": shape} if shape else None)


RGB = _fixed(pa.uint8(), 3 * _NUM_PIXELS)
SEGM = _fixed(pa.uint8(), _NUM_PIXELS)
_RGB_SHAPE = f"{IMAGE_SHAPE[0]},{IMAGE_SHAPE[1]},3"
_SEGM_SHAPE = f"{IMAGE_SHAPE[0]},{IMAGE_SHAPE[1]}"

POSE = _fixed(pa.float64(), 7)  # x, y, z in metres, quaternion xyzw
JOINTS = _fixed(pa.float32(), 6)  # radians

RECORD = pa.struct([_field("id", pa.int32()), _field("object", pa.string()), _field("texture", pa.string())])
OBJECT = pa.struct(
    [
        *RECORD,
        _field("size", _fixed(pa.float64(), 3)),
        _field("scale", _fixed(pa.float64(), 3)),
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
        _field("poses", _list(POSE), "steps + 1,objects,7"),
        _field("pose0_position", _list(_fixed(pa.float32(), 2))),
        _field("pose0_rotation", _list(_fixed(pa.float32(), 4))),
        _field("pose1_position", _list(_fixed(pa.float32(), 2))),
        _field("pose1_rotation", _list(_fixed(pa.float32(), 4))),
        _field("pick_ids", _list(pa.int32())),
        _field("place_ids", _list(pa.int32())),
        _field("joint_paths", _list(_list(JOINTS))),
        _field("prompt", pa.string()),
        _field("prompt_images", _list(PROMPT_IMAGE)),
        *(_field(f"prompt_rgb_{view}", _list(RGB), _RGB_SHAPE) for view in VIEWS),
        *(_field(f"prompt_segm_{view}", _list(SEGM), _SEGM_SHAPE) for view in VIEWS),
        *(_field(f"rgb_{view}", _list(RGB), _RGB_SHAPE) for view in VIEWS),
        *(_field(f"segm_{view}", _list(SEGM), _SEGM_SHAPE) for view in VIEWS),
    ]
)

# Columns that list arrays of one shape: their dtype and shape.
ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "poses": ("<f8", (7,)),
    **{name: ("<f4", (width,)) for name, width in ACTION_SHAPES.items()},
    **{f"{kind}rgb_{view}": ("u1", (*IMAGE_SHAPE, 3)) for kind in ("prompt_", "") for view in VIEWS},
    **{f"{kind}segm_{view}": ("u1", IMAGE_SHAPE) for kind in ("prompt_", "") for view in VIEWS},
}
IMAGES = frozenset(name for name, (_, shape) in ARRAYS.items() if shape[:2] == IMAGE_SHAPE)
NUMBERS = frozenset({*ARRAYS, "joint_paths"}) - IMAGES
