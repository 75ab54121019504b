"""Batches of training equal the inputs of a policy in the same episodes."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from naive_inputs import NaiveProcessor, batch_histories, batch_prompts
from openvima.data.preprocessed import number_images, preprocess
from openvima.errors import DatasetError
from openvima.perception.objects import GROUND_TRUTH, PUBLISHED_ORDER, ObjectViews, crop_box
from openvima.perception.preprocessing import ImageStack
from openvima.policies.nn.actions import ACTION_PARTS
from openvima.policies.processor import Processor
from small_networks import collate_examples, examples_of

SETTINGS = {
    "objects": {"layout": "objects"},
    "views": {"layout": "views"},
    "frames": {"layout": "frames", "image_size": (64, 128), "tokens_per_image": 3},
}
OBJECTS = Processor("objects")


def as_when_acting(demos, naive: NaiveProcessor):
    """Prompts and histories read one by one by the naive twin, and their images."""
    stack = ImageStack(naive.image_size)

    def add(objects: ObjectViews) -> np.ndarray:
        numbers = np.zeros(objects.masks.shape, np.int64)
        numbers[objects.masks] = stack.add(objects.crops[objects.masks])
        return numbers

    prompts = [naive.encode_prompt(demo.prompt) for demo in demos]
    histories = []
    for demo in demos:
        episode = naive.start_episode()
        histories.append([episode.encode_step(demo.observation(t)) for t in range(demo.num_steps)])
    prompt_batch = batch_prompts(prompts, [add(prompt.objects) for prompt in prompts])
    numbers = [[add(step.objects) for step in history] for history in histories]
    return prompt_batch, batch_histories(histories, numbers), torch.from_numpy(stack.images())


def acting(demos, processor: Processor):
    """Prompts and histories as a policy encodes them, and their images."""
    prompts, stack = processor.encode_prompts([demo.prompt for demo in demos])
    histories = [[demo.observation(t) for t in range(demo.num_steps)] for demo in demos]
    history, stack = processor.encode_observations(histories, stack=stack)
    return prompts, history, torch.from_numpy(stack.images())


@pytest.mark.parametrize("layout", SETTINGS)
def test_training_and_inference_have_equal_inputs(layout, demonstrations_of_several_steps):
    processor, demos = Processor(**SETTINGS[layout]), demonstrations_of_several_steps
    examples, images = examples_of(demos, processor)
    batch = collate_examples(processor, examples)
    naive = NaiveProcessor(
        **SETTINGS[layout], extractor=PUBLISHED_ORDER if layout == "views" else GROUND_TRUTH
    )
    for *expected, expected_images in (as_when_acting(demos, naive), acting(demos, processor)):
        for ours, theirs in zip((batch.prompts, batch.history), expected, strict=True):
            for field in fields(ours):
                got, asked = getattr(ours, field.name), getattr(theirs, field.name)
                if field.name.startswith("crop_index"):  # the numbers differ, what they name does not
                    got, asked = images[got], expected_images[asked]
                assert got.dtype == asked.dtype, field.name
                assert torch.equal(got, asked), field.name


def test_slots_of_views_never_fall_from_step_to_step(demonstrations_of_several_steps):
    processor = Processor("views")
    for demo in demonstrations_of_several_steps:
        observations = [demo.observation(t) for t in range(demo.num_steps)]
        whole, _ = processor.encode_observations([observations])
        num_slots = None
        for t, observation in enumerate(observations):
            step, _ = processor.encode_observations([[observation]], num_slots)
            num_slots = step.num_slots_BT[:, -1].tolist()
            assert num_slots == [whole.num_slots_BT[0, t]]


def test_targets_are_the_actions_of_the_oracle(demonstrations_of_several_steps):
    demos = demonstrations_of_several_steps
    batch = collate_examples(OBJECTS, examples_of(demos, OBJECTS)[0])
    for b, demo in enumerate(demos):
        assert batch.targets.steps_BT[b].sum() == demo.num_steps
        for t, action in enumerate(demo.actions):
            asked = np.concatenate([np.asarray(getattr(action, part)) for part in ACTION_PARTS])
            np.testing.assert_allclose(batch.targets.actions_BTC[b, t], asked, atol=1e-6)
        assert not batch.targets.actions_BTC[b, demo.num_steps :].any()
        assert (batch.targets.pick_BT[b, demo.num_steps :] == -1).all()


def test_false_positives_are_crops_of_the_frame(demonstrations_of_several_steps):
    demos = demonstrations_of_several_steps
    examples, images = examples_of(demos, OBJECTS)
    spurious = collate_examples(OBJECTS, examples).false_positives
    for b, demo in enumerate(demos):
        for t in range(demo.num_steps):
            for v, view in enumerate(("front", "top")):
                x, y, height, width = spurious.boxes[b, t, v]
                extent = (x - width // 2, x - width // 2 + width, y - height // 2, y - height // 2 + height)
                crop, box = crop_box(demo.rgb[view][t], extent)
                assert np.array_equal(crop, images[spurious.crop_index[b, t, v]])
                assert np.array_equal(box, spurious.boxes[b, t, v])


def test_examples_of_a_batch_are_independent(demonstrations_of_several_steps):
    examples, _ = examples_of(demonstrations_of_several_steps, OBJECTS)
    together, alone = (collate_examples(OBJECTS, part) for part in (examples, examples[2:3]))
    steps, slots = alone.history.crop_index_BTVN.shape[1], alone.history.crop_index_BTVN.shape[3]
    assert torch.equal(together.history.boxes_BTVN4[2, :steps, :, :slots], alone.history.boxes_BTVN4[0])
    assert not together.history.masks_BTVN[2, steps:].any()
    length = alone.prompts.word_ids_BL.shape[1]
    assert torch.equal(together.prompts.word_ids_BL[2, :length], alone.prompts.word_ids_BL[0])


def test_an_episode_without_visible_objects_is_named(demonstrations_of_several_steps):
    tokens = preprocess(demonstrations_of_several_steps[-1], "objects")
    none = np.zeros_like(tokens.objects_per_step)
    blind = replace(tokens, objects=tokens.objects.select(slice(0)), objects_per_step=none)
    with pytest.raises(DatasetError, match=f"episode {tokens.seed} of {tokens.task} shows no object before"):
        OBJECTS.collate([blind])


def test_a_batch_holds_each_image_in_use_once(demonstrations_of_several_steps):
    examples, stack = examples_of(demonstrations_of_several_steps, OBJECTS)
    episodes = number_images([example.episode for example in examples])
    numbered = OBJECTS.collate(episodes)
    left_out = numbered.history.crop_index_BTVN[1].unique()[-3]  # as if augmentation had hidden an object
    history = replace(
        numbered.history,
        crop_index_BTVN=numbered.history.crop_index_BTVN.masked_fill(
            numbered.history.crop_index_BTVN == left_out, 0
        ),
    )
    for plain in (numbered, replace(numbered, history=history)):
        batch = plain.with_images([episode.images for episode in episodes])
        used = torch.cat([plain.prompts.crop_index_VS.flatten(), plain.history.crop_index_BTVN.flatten()])
        assert len(batch.images) == len(used.unique())
        for ours, theirs in (
            (batch.prompts.crop_index_VS, plain.prompts.crop_index_VS),
            (batch.history.crop_index_BTVN, plain.history.crop_index_BTVN),
        ):
            assert torch.equal(batch.images[ours], stack[theirs])
