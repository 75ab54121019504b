"""Prompts interleave text and images."""

import numpy as np
import pytest

from openvima.errors import PromptError
from openvima.scene import ObjectImage, Placement, Pose, Prompt, PromptImage, RenderedPrompt

IMAGE = ObjectImage(Placement(5, "block", "red", (0.07, 0.07, 0.07), Pose.planar(0.5, 0.0)))


def rendered(name: str) -> PromptImage:
    nothing = np.zeros((3, 128, 256), np.uint8)
    return PromptImage(name, "object", {"top": nothing}, {"top": nothing[0]}, ())


def test_words_and_numbers_enter_the_text_and_images_keep_their_place() -> None:
    prompt = Prompt.parse("Put {det} {b} into {a}, {angle} times.", det="any", angle=3, a=IMAGE, b=IMAGE)
    assert prompt.text == "Put any {b} into {a}, 3 times."
    assert [name for name, _ in prompt.images] == ["b", "a"]  # in reading order


def test_a_placeholder_that_occurs_twice_has_one_image() -> None:
    prompt = Prompt.parse("First {a}, then {b}, then {a}.", a=IMAGE, b=IMAGE)
    assert [name for name, _ in prompt.images] == ["a", "b"]


@pytest.mark.parametrize("fills", [{}, {"a": IMAGE, "b": IMAGE}])
def test_slots_and_fills_must_be_the_same(fills: dict[str, ObjectImage]) -> None:
    with pytest.raises(PromptError, match="slots"):
        Prompt.parse("Look at {a}.", **fills)


def test_a_rendered_prompt_reads_as_an_interleaved_sequence() -> None:
    a, b = rendered("a"), rendered("b")
    prompt = RenderedPrompt("Put the {a} into the {b}.", {"a": a, "b": b})
    assert prompt.sequence() == ["Put the", a, "into the", b, "."]


def test_a_rendered_prompt_without_an_image_is_refused() -> None:
    with pytest.raises(PromptError, match="names images"):
        RenderedPrompt("Put the {a}.", {}).sequence()
