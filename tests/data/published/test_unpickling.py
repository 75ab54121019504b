"""Pickles are read as data: what they hold comes out, and nothing that they name is ever run."""

import functools
import io
import itertools
import os
import pickle
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import published_data
from openvima.data.published_episode import Inert, as_array, read_pickle
from openvima.errors import DatasetError

PROTO = b"\x80\x04"
SCALARS = st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats(allow_nan=False) | st.text()
VALUES = st.recursive(
    SCALARS | st.binary(),
    lambda inner: (
        st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text() | st.integers(), inner)
    ),
    max_leaves=15,
)


@settings(max_examples=50)
@given(VALUES, st.integers(3, 5))
def test_plain_values_come_back(value: object, protocol: int) -> None:
    assert read_pickle(pickle.dumps(value, protocol)) == value


def test_what_occurs_twice_comes_back_twice() -> None:
    inner = ["a", "b"]
    first, second = read_pickle(pickle.dumps([inner, inner], 4))
    assert first is second


@pytest.mark.parametrize("protocol", [4, 5])
@pytest.mark.parametrize("dtype", ["|u1", "<i8", ">i2", "<f4", ">f8", "?", "<u4"])
def test_arrays_come_back(dtype: str, protocol: int) -> None:
    array = np.arange(24).astype(dtype).reshape(2, 3, 4)
    single = array[1, 1, 1:2].reshape(())
    for value in (
        array,
        np.asfortranarray(array),
        array[:0],
        array.transpose(1, 0, 2),
        array[:, ::2],
        single,
    ):
        for content in (pickle.dumps(value, protocol), published_data.pickled(value, protocol)):
            read = as_array(read_pickle(content))
            assert read.dtype == array.dtype
            assert np.array_equal(read, value)
            assert not read.flags.writeable


@pytest.mark.parametrize(
    ("args", "is_sound"),
    [
        ((b"abc", (10**12,), "C"), False),
        ((b"abc", (-1, 5), "C"), False),
        ((b"abc", (3,), "X"), False),
        ((b"abc", (3,), None), True),
        ((b"abc", (3,), "K", (1,)), False),
        ((b"abc", (3,), "K", (0, 0)), False),
        ((b"abc", (3,), "K", (0,), 1), False),
        ((b"abc", (3,), "K"), True),
        ((b"abc",), False),
        (("text", (4,), "C"), False),
        (([1, 2], (2,), "C"), False),
    ],
)
def test_arrays_of_protocol_5_fit_their_bytes(args: tuple, is_sound: bool) -> None:
    content, *rest = args
    sink = io.BytesIO()
    pickle.Pickler(sink, 5).dump((content, Calls(np.dtype, "u1", False, True), *rest))
    made = sink.getvalue().removeprefix(b"\x80\x05").removesuffix(b".")
    pickled = b"\x80\x05" + named("numpy.core.numeric", "_frombuffer") + made + b"R."
    if is_sound:
        assert as_array(read_pickle(pickled)).tolist() == [*b"abc"]
        return
    with pytest.raises(DatasetError, match="no pickle of data"):
        read_pickle(pickled)


@pytest.mark.parametrize("number", [np.int64(-3), np.float32(0.5), np.bool_(True), np.uint8(9)])
def test_numbers_of_numpy_come_back(number: np.generic) -> None:
    value = read_pickle(pickle.dumps(number, 4))
    assert value == number
    assert type(value) is type(number.item())


def test_objects_become_inert() -> None:
    episode = published_data.MadeEpisode()
    generations = (published_data.PUBLISHED, published_data.TODAY)
    for generation, protocol in itertools.product(generations, (4, 5)):
        fields = read_pickle(published_data.pickled(episode.trajectory(generation), protocol))
        info = fields["obj_id_to_info"][5]
        for name in ("obj_size_range", "obj_profile", "obj_replace_fn"):
            assert type(info[name]) is Inert


class Calls:
    """Pickles as the call of a function."""

    def __init__(self, function: Callable, *args: object) -> None:
        self.call = function, args

    def __reduce__(self) -> tuple:
        return self.call


def text(value: str) -> bytes:
    return b"\x8c" + struct.pack("<B", len(value)) + value.encode()


def named(module: str, name: str) -> bytes:
    return text(module) + text(name) + b"\x93"


def attack(touch: str) -> dict[str, bytes]:
    """Pickles that run a command when `pickle` loads them."""
    eat = f"__import__('os').system({touch!r})"
    return {
        "os.system": PROTO + named("os", "system") + text(touch) + b"\x85R.",
        "builtins.eval": pickle.dumps(Calls(eval, eat), 4),
        "oldest protocol": pickle.dumps(Calls(os.system, touch), 0),
        "INST": b"(X" + struct.pack("<I", len(touch)) + touch.encode() + b"ios\nsystem\n.",
        "a dotted name": PROTO + named("shutil", "os.system") + text(touch) + b"\x85R.",
        "a call in an array, protocol 5": pickle.dumps(np.array([Calls(os.system, touch)], dtype=object), 5),
        "functools.partial": pickle.dumps(Calls(functools.partial(os.system, touch)), 4),
        "a call in an array": pickle.dumps(np.array([Calls(os.system, touch)], dtype=object), 4),
        "a default that calls": PROTO
        + named("collections", "defaultdict") + named("os", "getcwd") + b"\x85R0"
        + named("os", "system") + text(touch) + b"\x85R.",
    }  # fmt: skip


@pytest.mark.parametrize("kind", sorted(attack("")))
def test_hostile_pickles_are_refused_and_nothing_runs(kind: str, tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    content = attack(f"touch {marker}")[kind]
    with pytest.raises(
        DatasetError, match=r"nothing was run|no pickle of data|only numbers are read"
    ) as error:
        read_pickle(content)
    assert not marker.exists()
    pickle.loads(content)
    assert marker.exists(), "this pickle is not hostile"
    if kind in ("os.system", "builtins.eval"):
        assert f"names {kind}," in str(error.value)


SIZE_RANGE = named("vimasim.tasks.components.encyclopedia.definitions", "SizeRange")


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (SIZE_RANGE + b")\x81)R", "'Inert' object is not callable"),
        (text("os") + b")R", "'str' object is not callable"),
        (b"]" + b"}" + text("append") + b"Nsb", "'list' object has no attribute"),
        (named("numpy", "load"), "names numpy.load,"),
        (named("functools", "partial.__class__"), "names functools.partial.__class__,"),
        (named("numpy", "ndarray.tofile"), "names numpy.ndarray.tofile,"),
        (b"Pid\n", "no pickle of data"),
        (SIZE_RANGE + b")\x81(K\x01e", "'Inert' object has no attribute 'append'"),
    ],
)
def test_what_no_published_file_does_is_refused(content: bytes, fault: str) -> None:
    with pytest.raises(DatasetError, match=fault):
        read_pickle(PROTO + content + b".")


def array_pickle(shape: object, dtype: str, content: object) -> bytes:
    """A pickle of an array with a head that need not fit."""
    sink = io.BytesIO()
    pickler = pickle.Pickler(sink, 4)
    pickler.dump((1, shape, Calls(np.dtype, dtype, False, True), False, content))
    state = sink.getvalue().removeprefix(PROTO).removesuffix(b".")
    made = (
        named("numpy.core.multiarray", "_reconstruct") + named("numpy", "ndarray") + b"K\x00\x85C\x01b\x87R"
    )
    return PROTO + made + state + b"b."


@pytest.mark.parametrize(
    ("shape", "dtype", "content", "fault"),
    [
        ((10**30,), "u1", b"abc", "no pickle of data"),
        ((-1, 5), "u1", b"abc", "no pickle of data"),
        ((2.5,), "u1", b"ab", "no pickle of data"),
        ((1,) * 100, "u1", b"a", "no pickle of data"),
        ((1,), "O8", b"12345678", "type 'O8'; only numbers"),
        ((1,), "M8", b"12345678", "type 'M8'; only numbers"),
        ((1,), "u1", [1], "no pickle of data"),
        ((3,), "f8", b"abc", "no pickle of data"),
    ],
)
def test_arrays_are_never_larger_than_their_bytes(
    shape: object, dtype: str, content: object, fault: str
) -> None:
    with pytest.raises(DatasetError, match=fault):
        read_pickle(array_pickle(shape, dtype, content))


def test_no_beginning_of_a_pickle_reads_as_whole() -> None:
    content = published_data.pickled(published_data.MadeEpisode().actions(3))
    for length in range(len(content)):
        with pytest.raises(DatasetError):
            read_pickle(content[:length])


@given(st.data())
def test_damage_gives_a_value_or_an_error_that_says_so(data: st.DataObject) -> None:
    values = {"a": [1, 2.5, None], "b": np.arange(4), "c": (True, b"bytes", "text" * 20)}
    whole = published_data.pickled(values, data.draw(st.sampled_from([4, 5])))
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        read_pickle(bytes(content))
    except DatasetError as error:
        assert len(str(error)) < 400
