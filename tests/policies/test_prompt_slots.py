"""How many slots the images of a prompt take, with a token for each view."""

from dataclasses import replace

import numpy as np

from openvima.perception.objects import ObjectViews, make_hidden_objects
from openvima.policies.batch import WORD, PromptBatch
from openvima.policies.processor import Processor
from openvima.scene import PromptImage, RenderedPrompt


class Scripted:
    """Finds in an image what its name says: for each object the views that show it, as in "ft_f_t"."""

    def in_prompt_image(self, image: PromptImage) -> ObjectViews:
        shown = image.name.split("_")
        masks = np.array([[view in views for views in shown] for view in "ft"])
        return replace(make_hidden_objects(len(shown)), masks=masks)

    def in_observation(self, observation):
        raise NotImplementedError


def read(*names: str) -> PromptBatch:
    images = {name: PromptImage(name, "scene", {}, {}, ()) for name in names}
    prompt = RenderedPrompt("put " + " ".join(f"{{{name}}}" for name in names), images)
    batch, _ = Processor("views", extractor=Scripted()).encode_prompts([prompt])
    return batch


def parts_and_entries(batch: PromptBatch):
    """View and row of each image token, in the order of the prompt."""
    index = batch.object_index_BL[0]
    num_objects = batch.masks_VS.shape[1]
    return index[index != WORD] // num_objects, index[index != WORD] % num_objects


def test_every_image_takes_as_many_slots_as_the_fullest_one_of_each_view():
    prompt = read("ft", "ft_ft_f")
    parts, _ = parts_and_entries(prompt)
    # front slots before top slots, three and two in both images; one word before them, the end after
    assert parts.tolist() == [0, 0, 0, 1, 1] * 2
    assert prompt.mask_BL[0].tolist() == [
        *[True],
        *[True, False, False, True, False],
        *[True, True, True, True, True],
        *[True],
    ]


def test_an_object_that_a_view_hides_takes_no_slot_there():
    prompt = read("f_t")
    parts, _ = parts_and_entries(prompt)
    assert parts.tolist() == [0, 1] and prompt.mask_BL.all()


def test_slots_of_padding_show_nothing_and_are_no_other_images():
    prompt = read("ft", "ft_ft")
    parts, entries = parts_and_entries(prompt)
    seen = prompt.masks_VS[parts, entries]
    assert (seen == prompt.mask_BL[0, prompt.object_index_BL[0] != WORD]).all()
    first, second = entries[:4].tolist(), entries[4:].tolist()
    assert set(first).isdisjoint(second)
