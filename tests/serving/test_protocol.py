"""Prompts, observations and actions in messages."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import msgpack
import numpy as np
import pytest

from openvima.env import TabletopEnv
from openvima.errors import MessageError, PolicyError, ServerError
from openvima.evaluation import score
from openvima.policies import RandomPolicy
from openvima.serving import RemotePolicy, serve_in_thread
from openvima.serving.protocol import (
    DTYPES,
    MAX_LENGTH,
    decode_action,
    decode_observation,
    decode_prompt,
    encode_action,
    encode_observation,
    encode_prompt,
    pack,
    unpack,
)
from served_policies import made_up_observation, made_up_prompt


def test_an_episode_comes_out_of_messages_as_it_went_in() -> None:
    env = TabletopEnv("novel_noun", domain="user")  # its prompt holds several images, with words between
    observation = env.reset(seed=1)[0]
    prompt = decode_prompt(unpack(pack(encode_prompt(env.prompt))))
    assert prompt.text == env.prompt.text and list(prompt.images) == list(env.prompt.images)
    for name, image in env.prompt.images.items():
        found = prompt.images[name]
        assert (found.name, found.kind, found.objects) == (image.name, image.kind, image.objects)
        for part in ("rgb", "segm"):
            for view, pixels in getattr(image, part).items():
                np.testing.assert_array_equal(getattr(found, part)[view], pixels, strict=True)
    seen = decode_observation(unpack(pack(encode_observation(observation))))
    assert seen is not None and seen["ee"] == observation["ee"]
    for part in ("rgb", "segm"):
        for view, pixels in observation[part].items():
            np.testing.assert_array_equal(seen[part][view], pixels, strict=True)
    policy = RandomPolicy()
    policy.reset([env.prompt])
    (action,) = policy.act([observation])
    sent = decode_action(unpack(pack(encode_action(action))))
    assert action is not None and sent is not None and sent.keys() == action.keys()
    for key, array in action.items():
        np.testing.assert_array_equal(sent[key], array, strict=True)


def test_a_prompt_may_be_text_alone_and_an_observation_lack_the_segmentation() -> None:
    assert decode_prompt({"text": "Rotate."}).images == {}
    message = made_up_observation(1)
    del message["segm"]
    assert decode_observation(message) == message


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("text",), 3, "prompt: text is 3; it must be a text"),
        (("text",), ..., "lacks 'text'"),
        (("images",), {}, "images is a dict; it must be a list"),
        (("colour",), 3, "'colour', which nobody knows"),
        (("images", 0, "name"), None, "images 0: name is None"),
        (("images", 0, "kind"), "photo", "allowed: object, scene"),
        (("images", 0, "kind"), np.zeros(3), "allowed: object, scene"),
        (("images", 0, "rgb", "top"), b"", "rgb: top is b''; it must be an array"),
        (("images", 0, "rgb", "top"), np.zeros((4, 8), np.uint8), r"uint8 \(3, any, any,\)"),
        (("images", 0, "rgb", "top"), np.zeros((3, 4, 8), np.float32), "float32"),
        (("images", 0, "objects", 0), 3, "objects 0 is 3; it must be a map"),
        (("images", 0, "objects", 0, "object_id"), True, "object_id is True; it must be a whole number"),
    ],
)
def test_what_is_wrong_in_a_prompt_is_said(path: tuple, value: object, message: str) -> None:
    sent = deepcopy(encode_prompt(made_up_prompt(1)))
    place = sent
    for key in path[:-1]:
        place = place[key]
    if value is ...:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    with pytest.raises(MessageError, match=message):
        decode_prompt(sent)


def test_two_images_of_one_name_are_refused() -> None:
    sent = encode_prompt(made_up_prompt(1))
    with pytest.raises(MessageError, match="one name"):
        decode_prompt({**sent, "images": sent["images"] * 2})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ee": True}, "ee is True"),
        ({"ee": 0.0}, "ee is 0.0"),
        ({"rgb": {"top": 3}}, "rgb: top is 3"),
        ({"depth": 3}, "'depth', which nobody knows"),
    ],
)
def test_what_is_wrong_in_an_observation_is_said(change: dict, message: str) -> None:
    with pytest.raises(MessageError, match=message):
        decode_observation(made_up_observation(1) | change)


TOOL = np.array([0.5, 0.1, 0.3, -1.0, 1.0], np.float32)
OBSERVATION = {**made_up_observation(1), "tool": TOOL}
ROTATE = {"tasks": ("rotate",), "levels": ("L1",), "episodes": 1}


class Follows:
    """Moves by a tenth of the tool's pose."""

    control = "end_effector"

    def reset(self, prompts: Sequence[Any]) -> None:
        pass

    def act(self, observations: Sequence[Mapping | None]) -> list[Any]:
        return [None if seen is None else seen["tool"] / 10 for seen in observations]


def test_commands_and_the_pose_of_the_tool_pass_unchanged() -> None:
    env = TabletopEnv("rotate", level="L1", control="end_effector", modalities=("rgb",))
    seen, _ = env.reset(seed=0)
    with serve_in_thread(Follows()) as url, RemotePolicy(url) as remote:
        assert remote.control == remote.metadata["control"] == "end_effector"
        remote.reset([env.prompt, env.prompt])
        for _ in range(2):
            command, none = remote.act([seen, None])
            np.testing.assert_array_equal(command, seen["tool"] / 10, strict=True)
            assert none is None
            seen, *_ = env.step(command)


def test_policies_of_the_other_control_are_refused_on_both_sides() -> None:
    with serve_in_thread(Follows()) as url, RemotePolicy(url) as remote:
        with pytest.raises(PolicyError, match="'end_effector', but the environments have control 'primit"):
            score({"remote": remote}, **ROTATE)
        remote.reset([made_up_prompt(1)])
        with pytest.raises(ServerError, match="observation 0: it lacks 'tool'"):
            remote.act([made_up_observation(1)])
    with serve_in_thread(RandomPolicy()) as url, RemotePolicy(url) as remote:
        assert remote.control == "primitives"
        with pytest.raises(PolicyError, match="'primitives', but the environments have control 'end_eff"):
            score({"remote": remote}, **ROTATE, control="end_effector")
        remote.reset([made_up_prompt(1)])
        with pytest.raises(ServerError, match="it has 'tool', which nobody knows"):
            remote.act([OBSERVATION])


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
        (pack({"a": 1})[:-1], "no whole MessagePack"),
        (pack(1) + pack(2), "no whole MessagePack"),
        (msgpack.packb({1: 2}), "no whole MessagePack"),
        (msgpack.packb(msgpack.ExtType(5, b"x")), "no whole MessagePack"),
        (b"\x91" * 5000 + b"\xc0", "no whole MessagePack"),
        (b"\xdd\xff\xff\xff\xff", "no whole MessagePack"),
        (array_message(dtype="|O"), "one of the dtypes .*u1"),
        (array_message(dtype=["u1"]), "dtype"),
        (array_message(data="\0" * 6), "an array is damaged"),
        (array_message(data=b"\0" * 5), "an array is damaged"),
        (array_message(shape=[2**31 - 1] * 8), "an array is damaged"),
        (array_message(shape=[-2, -3]), "shape"),
        (array_message(shape=[6.0]), "shape"),
        (array_message(shape=[True, 6]), "shape"),
        (array_message(shape=6), "shape"),
        (msgpack.packb({b"__ndarray__": True}), "must have the entries"),
        (b"\xdc" + MAX_LENGTH.to_bytes(2, "big") + b"\x80" * MAX_LENGTH + b"!", "no whole MessagePack"),
    ],
)
def test_what_is_no_message_is_refused_with_a_reason(data: bytes, message: str) -> None:
    with pytest.raises(MessageError, match=message):
        unpack(data)
