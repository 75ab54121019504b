"""How many slots the images of a prompt take, with a token for each view."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")

from openvima.perception.objects import ObjectViews, see_nothing
from openvima.policies.inputs import WORD, Reader
from openvima.scene import PromptImage, RenderedPrompt


class Scripted:
    """Finds in an image what its name says: for each object the views that show it, as in "ft_f_t"."""

    def in_prompt_image(self, image: PromptImage) -> ObjectViews:
        shown = image.name.split("_")
        masks = np.array([[view in views for views in shown] for view in "ft"])
        return replace(see_nothing(len(shown)), masks=masks)

    def in_observation(self, observation):
        raise NotImplementedError


def read(*names: str):
    images = {name: PromptImage(name, "scene", {}, {}, ()) for name in names}
    prompt = RenderedPrompt("put " + " ".join(f"{{{name}}}" for name in names), images)
    return Reader("views", extractor=Scripted()).read_prompt(prompt)


def test_every_image_takes_as_many_slots_as_the_fullest_one_of_each_view():
    prompt = read("ft", "ft_ft_f")
    image = prompt.entries != WORD
    # front slots before top slots, three and two in both images; one word before them, the end after
    assert prompt.parts[image].tolist() == [0, 0, 0, 1, 1] * 2
    assert prompt.mask.tolist() == [
        *[True],
        *[True, False, False, True, False],
        *[True, True, True, True, True],
        *[True],
    ]


def test_an_object_that_a_view_hides_takes_no_slot_there():
    prompt = read("f_t")
    assert prompt.parts[prompt.entries != WORD].tolist() == [0, 1] and prompt.mask.all()


def test_slots_of_padding_show_nothing_and_are_no_other_images():
    prompt = read("ft", "ft_ft")
    image = prompt.entries != WORD
    seen = prompt.objects.masks[prompt.parts[image], prompt.entries[image]]
    assert (seen == prompt.mask[image]).all()
    first, second = prompt.entries[image][:4], prompt.entries[image][4:]
    assert set(first).isdisjoint(second)
