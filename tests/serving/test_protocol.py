"""Prompts, observations and actions in messages."""

import re
from copy import deepcopy

import numpy as np
import pytest

from openvima.env import TabletopEnv
from openvima.errors import ConfigError, MessageError
from openvima.policies.base import RandomPolicy
from openvima.serving.protocol import (
    check_protocol,
    check_token,
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


def test_none_stands_for_an_episode_that_has_ended() -> None:
    assert encode_observation(None) is decode_observation(None) is None
    assert encode_action(None) is decode_action(None) is None


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
        (("images", 0), 7, "images 0 is 7; it must be a map"),
        (("images", 0, "name"), None, "images 0: name is None"),
        (("images", 0, "kind"), "photo", "allowed: object, scene"),
        (("images", 0, "kind"), [], "allowed: object, scene"),
        (("images", 0, "kind"), np.zeros(3), "allowed: object, scene"),
        (("images", 0, "rgb"), [1], "rgb is a list; it must be a map"),
        (("images", 0, "rgb", "top"), b"", "rgb: top is b''; it must be an array"),
        (("images", 0, "rgb", "top"), np.zeros((4, 8), np.uint8), r"uint8 \(3, any, any,\)"),
        (("images", 0, "rgb", "top"), np.zeros((3, 4, 8), np.float32), "float32"),
        (("images", 0, "segm", "top"), np.zeros((4, 9), np.uint8), "as large as rgb"),
        (("images", 0, "objects", 0), 3, "objects 0 is 3; it must be a map"),
        (("images", 0, "objects", 0, "object_id"), True, "object_id is True; it must be a whole number"),
        (("images", 0, "objects", 0, "texture"), None, "texture is None"),
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
        ({"ee": None}, "ee is None"),
        ({"ee": True}, "ee is True"),
        ({"ee": 0.0}, "ee is 0.0"),
        ({"rgb": {"top": 3}}, "rgb: top is 3"),
        ({"depth": 3}, "'depth', which nobody knows"),
    ],
)
def test_what_is_wrong_in_an_observation_is_said(change: dict, message: str) -> None:
    with pytest.raises(MessageError, match=message):
        decode_observation(made_up_observation(1) | change)


def test_other_versions_are_named() -> None:
    with pytest.raises(MessageError, match=re.escape("it speaks 'openvima-policy/2', I 'openvima-policy/1'")):
        check_protocol("openvima-policy/2", theirs="it", ours="I")
    with pytest.raises(MessageError, match="speaks None"):
        check_protocol(None, theirs="it", ours="I")


@pytest.mark.parametrize("token", ["", "two words", "line\nbreak", "ümlaut"])
def test_tokens_that_no_header_can_hold_are_refused(token: str) -> None:
    with pytest.raises(ConfigError, match="token"):
        check_token(token)
