"""Messages as bytes: MessagePack, with arrays in the form that open policy servers use.

An array is a map of four entries with byte strings as keys: `__ndarray__` (true), `data` (its bytes, rows
first), `dtype` (as numpy writes it, such as "<f4") and `shape`. Nothing is ever unpickled, no type is looked
up by a name that came with the message, and a length counts only after it was compared with the bytes that
are there.
"""

import math
from typing import Any

import numpy as np

from openvima.errors import MessageError
from openvima.extras import import_extra

DTYPES = {
    dtype.str: dtype
    for dtype in map(np.dtype, ("u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f2", "f4", "f8"))
}
MAX_AXES = 8
# A million empty maps are a megabyte of MessagePack and 72 MB of Python. These bound what a message can take
# beyond its own size: the values in all its lists and maps; and those of one, as older versions of msgpack
# set memory aside for what a list claims to hold. A batch of 256 episodes has some 170,000 values.
MAX_VALUES = 1_000_000
MAX_LENGTH = 4096

_ARRAY = b"__ndarray__"
_NUMBER = b"__npgeneric__"  # a single number of numpy, as some clients send it
_ARRAY_KEYS = frozenset((_ARRAY, b"data", b"dtype", b"shape"))


def require_extra() -> None:
    """Check that messages can be packed and sent.

    Raises:
        MissingExtraError: A package is missing; the message names the extra.
    """
    for module in ("msgpack", "websockets"):
        import_extra(module, f"policy servers need {module}; install it with: pip install 'openvima[serve]'")


def pack(message: object) -> bytes:
    """Turn plain values and arrays into bytes.

    Args:
        message: None, booleans, numbers, texts, byte strings, lists and maps of such, and numpy arrays.

    Raises:
        MessageError: It holds something else, such as an array of Python objects.
    """
    import msgpack

    try:
        packed = msgpack.packb(message, default=_pack_array)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, MessageError):
            raise
        raise MessageError(f"the message cannot be packed: {error}") from error
    assert isinstance(packed, bytes)
    return packed


def unpack(data: bytes) -> Any:  # Any: whatever was sent
    """Turn bytes into plain values and arrays; the opposite of `pack`.

    Args:
        data: One whole message.

    Returns:
        What was packed. Arrays are new ones and may be written to.

    Raises:
        MessageError: The bytes are no MessagePack, or hold what is not allowed.
    """
    import msgpack

    counter = _ItemCounter()
    try:
        return msgpack.unpackb(
            data,
            object_hook=counter.map_or_array,
            list_hook=counter.list,
            max_array_len=MAX_LENGTH,
            max_map_len=MAX_LENGTH,
            max_ext_len=0,
        )
    except MessageError:
        raise
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        reason = str(error) or type(error).__name__
        raise MessageError(f"these {len(data):,} bytes are no whole MessagePack message: {reason}") from error


class _ItemCounter:
    """Counts the values of a message while it is read."""

    def __init__(self) -> None:
        self._num_values = 0

    def list(self, values: list) -> list:
        self._count(len(values))
        return values

    def map_or_array(self, entries: dict) -> Any:  # Any: a map stays one, an array or number becomes one
        self._count(len(entries))
        if _ARRAY in entries:
            return _unpack_array(entries)
        return _unpack_number(entries) if _NUMBER in entries else entries

    def _count(self, number: int) -> None:
        self._num_values += number + 1
        if self._num_values > MAX_VALUES:
            raise MessageError(f"the message holds more than {MAX_VALUES:,} values; arrays count as few.")


def _pack_array(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray):
        raise MessageError(
            f"a value of type {type(value).__name__} cannot be sent; allowed are plain values, with whole "
            "numbers of up to 64 bits, and arrays."
        )
    dtype = value.dtype.newbyteorder("<")
    _checked_dtype(dtype.str)
    data = np.ascontiguousarray(value, dtype).tobytes()
    return {_ARRAY: True, b"data": data, b"dtype": dtype.str, b"shape": list(value.shape)}


def _unpack_array(entries: dict) -> np.ndarray:
    if set(entries) != _ARRAY_KEYS:
        raise MessageError("an array must have the entries __ndarray__, data, dtype and shape, as bytes.")
    data, shape = entries[b"data"], entries[b"shape"]
    dtype = _checked_dtype(entries[b"dtype"])
    if not isinstance(data, bytes):
        raise MessageError(f"data of an array is a {type(data).__name__}; it must be a byte string.")
    if not _is_shape(shape):
        raise MessageError(
            f"shape of an array must be a list of at most {MAX_AXES} whole numbers from 0 to 2**31 - 1."
        )
    needed = math.prod(shape) * dtype.itemsize
    if needed != len(data):
        raise MessageError(
            f"an array {dtype.str} of shape {tuple(shape)} takes {needed:,} bytes, got {len(data):,}."
        )
    return np.ndarray(shape, dtype, data).copy()


def _unpack_number(entries: dict) -> int | float:
    value = entries.get(b"data")
    _checked_dtype(entries.get(b"dtype"))
    if not isinstance(value, int | float):
        raise MessageError(f"data of a number is a {type(value).__name__}; it must be a number.")
    return value


def _checked_dtype(text: object) -> np.dtype:
    if not isinstance(text, str) or text not in DTYPES:
        shown = repr(text[:20]) if isinstance(text, str) else f"a {type(text).__name__}"
        raise MessageError(f"dtype of an array is {shown}; allowed: {', '.join(DTYPES)}.")
    return DTYPES[text]


def _is_shape(shape: object) -> bool:
    return (
        isinstance(shape, list)
        and len(shape) <= MAX_AXES
        and all(type(length) is int and 0 <= length < 2**31 for length in shape)  # a bool is no length
    )
