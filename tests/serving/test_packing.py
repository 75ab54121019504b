"""Messages as bytes: what goes in comes out, and what must not come in does not."""

import pickle

import msgpack
import numpy as np
import pytest

from openvima.errors import MessageError
from openvima.serving.protocol import DTYPES, MAX_LENGTH, pack, unpack


def array_message(**changes: object) -> bytes:
    entries = {b"__ndarray__": True, b"data": b"\0" * 6, b"dtype": "|u1", b"shape": [2, 3]}
    for key, value in changes.items():
        entries[{"flag": b"__ndarray__"}.get(key, key.encode())] = value
    return msgpack.packb(entries)


@pytest.mark.parametrize("dtype", DTYPES.values(), ids=str)
@pytest.mark.parametrize("shape", [(), (0,), (5,), (2, 3), (2, 0, 4)])
def test_arrays_come_out_as_they_went_in(dtype: np.dtype, shape: tuple[int, ...]) -> None:
    array = np.arange(np.prod(shape), dtype=np.float64).reshape(shape).astype(dtype)
    (found,) = unpack(pack([array]))
    assert found.dtype == array.dtype and found.shape == array.shape
    assert found.tobytes() == array.tobytes()
    assert found.flags.writeable


def test_views_and_other_byte_orders_are_sent_by_their_values() -> None:
    array = np.arange(24, dtype=">f4").reshape(4, 6)[::2, ::-1]
    np.testing.assert_array_equal(unpack(pack(array)), array)


def test_plain_values_and_numbers_of_numpy_come_out_as_plain_values() -> None:
    message = {"a": [None, True, -1, 2**63, 0.1, "ü", b"\xff"], "b": {"c": {}}}
    assert unpack(pack(message)) == message
    assert unpack(pack([np.int64(3), np.float32(0.5), np.bool_(True)])) == [3, 0.5, True]


def test_an_array_has_the_form_that_other_servers_of_the_field_use() -> None:
    packed = pack({"x": np.array([[1, 2]], "<i2")})
    assert msgpack.unpackb(packed) == {
        "x": {b"__ndarray__": True, b"data": b"\1\0\2\0", b"dtype": "<i2", b"shape": [1, 2]}
    }
    other = msgpack.packb({b"__npgeneric__": True, b"data": 7, b"dtype": "<i8"})
    assert unpack(other) == 7


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.array([None]), r"'\|O'"),
        (np.array(["text"]), "dtype"),
        (np.zeros(2, "c8"), "c8"),
        (np.zeros(2, "M8[s]"), "dtype"),
        ({"x": object()}, "type object cannot be sent"),
        ({1, 2}, "type set"),
        (2**64, "up to 64 bits"),
    ],
)
def test_what_cannot_be_sent_is_named(value: object, message: str) -> None:
    with pytest.raises(MessageError, match=message):
        pack(value)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "no whole MessagePack"),
        (b"\xc1", "no whole MessagePack"),
        (pack({"a": 1})[:-1], "no whole MessagePack"),
        (pack(1) + pack(2), "no whole MessagePack"),
        (b"\xa2\xff\xfe", "no whole MessagePack"),
        (msgpack.packb({1: 2}), "no whole MessagePack"),
        (msgpack.packb(msgpack.ExtType(5, b"x")), "no whole MessagePack"),
        (msgpack.packb(msgpack.Timestamp(1)), "no whole MessagePack"),
        (pickle.dumps({"a": 1}), "no whole MessagePack"),
        (b"\x91" * 5000 + b"\xc0", "no whole MessagePack"),
        (b"\xdd\xff\xff\xff\xff", "no whole MessagePack"),
        (b"\xc6\xff\xff\xff\xff" + b"x", "no whole MessagePack"),
        (array_message(dtype="|O"), "one of the dtypes .*u1"),
        (array_message(dtype="O"), "dtype"),
        (array_message(dtype="<U3"), "dtype"),
        (array_message(dtype="V6"), "dtype"),
        (array_message(dtype="u1,u1"), "dtype"),
        (array_message(dtype=["u1"]), "dtype"),
        (array_message(dtype=None), "dtype"),
        (array_message(data="\0" * 6), "an array is damaged"),
        (array_message(data=[0] * 6), "an array is damaged"),
        (array_message(data=b"\0" * 5), "an array is damaged"),
        (array_message(shape=[2**40]), "shape"),
        (array_message(shape=[2**31 - 1] * 4), "an array is damaged"),
        (array_message(shape=[2**31 - 1] * 8), "an array is damaged"),
        (array_message(shape=[-2, -3]), "shape"),
        (array_message(shape=[6.0]), "shape"),
        (array_message(shape=[True, 6]), "shape"),
        (array_message(shape={}), "shape"),
        (array_message(shape=6), "shape"),
        (msgpack.packb({b"__ndarray__": True}), "must have the entries"),
        (b"\xdc" + MAX_LENGTH.to_bytes(2, "big") + b"\x80" * MAX_LENGTH + b"!", "no whole MessagePack"),
    ],
)
def test_what_is_no_message_is_refused_with_a_reason(data: bytes, message: str) -> None:
    with pytest.raises(MessageError, match=message):
        unpack(data)
