"""Batches of training equal the inputs of a policy in the same episodes."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from naive_inputs import PUBLISHED_ORDER, NaiveProcessor, batch_histories, batch_prompts
from openvima.data.preprocessed import number_images, preprocess
from openvima.detector.detection import DetectedObjects, Detections
from openvima.detector.plugins import PluggedExtractor
from openvima.errors import DatasetError
from openvima.perception.objects import GROUND_TRUTH, ObjectViews, crop_box
from openvima.perception.preprocessing import ImageStack
from openvima.policies.nn.actions import ACTION_PARTS
from openvima.policies.processor import Processor
from openvima.training.augmentation.prompts import motion_prompt
from openvima.training.batches import Example
from openvima.training.config import AugmentationConfig
from openvima.training.learner import PolicyCollate
from plugged_extractors import NoisyExtractor
from small_networks import collate_examples, examples_of

OBJECTS = Processor("objects")
FRAMES = {"tokens_per_image": 3}


class Guesses:
    """A noisy detector: random boxes that follow from the pixels of the image."""

    def detect(self, rgb: np.ndarray, view: str) -> Detections:
        """Draw a few boxes."""
        rng = np.random.default_rng(int(rgb.sum()))
        first = rng.integers((0, 0), (200, 90), (rng.integers(1, 9), 2))
        last = first + rng.integers(1, 38, first.shape)
        return Detections(np.concatenate([first, last], axis=1), scores=rng.random(len(first)))


EXTRACTORS = {
    "truth": GROUND_TRUTH,
    "noisy": PluggedExtractor(NoisyExtractor()),
    "guesses": PluggedExtractor(DetectedObjects(Guesses())),
}


def assert_as_when_acting(batch, demos, naive: NaiveProcessor, processor: Processor, prompts) -> None:
    """Compare a batch with what a policy encodes, and with what the naive twin reads step by step."""
    stack = ImageStack(processor.input_kind)

    def add(objects: ObjectViews) -> np.ndarray:
        numbers = np.zeros(objects.masks.shape, np.int64)
        if objects.masks.any():
            numbers[objects.masks] = stack.add(objects.crops[objects.masks])
        return numbers

    read = [naive.encode_prompt(prompt) for prompt in prompts]
    observations = [[demo.observation(t) for t in range(demo.num_steps)] for demo in demos]
    histories = []
    for seen in observations:
        episode = naive.start_episode()
        histories.append([episode.encode_step(each) for each in seen])
    expected_prompts = batch_prompts(read, [add(prompt.objects) for prompt in read])
    numbers = [[add(step.objects) for step in history] for history in histories]
    acting_prompts, acting_stack = processor.encode_prompts(prompts)
    acting_history, _ = processor.encode_observations(observations, stack=acting_stack)
    for images, *expected in (
        (stack.images(), expected_prompts, batch_histories(histories, numbers)),
        (acting_stack.images(), acting_prompts, acting_history),
    ):
        for ours, theirs in zip((batch.prompts, batch.history), expected, strict=True):
            for field in fields(ours):
                got, asked = getattr(ours, field.name), getattr(theirs, field.name)
                if field.name.startswith("crop_index"):  # the numbers differ, what they name does not
                    got, asked = batch.images[got], torch.from_numpy(images)[asked]
                assert got.dtype == asked.dtype, field.name
                assert torch.equal(got, asked), field.name


@pytest.mark.parametrize(
    ("layout", "name"),
    [*((layout, name) for layout in ("objects", "views") for name in EXTRACTORS), ("frames", "truth")],
)
def test_training_and_inference_have_equal_inputs(layout, name, demonstrations_of_several_steps) -> None:
    settings = {"layout": layout, **(FRAMES if layout == "frames" else {})}
    extractor, demos = EXTRACTORS[name], demonstrations_of_several_steps
    published = layout == "views" and name == "truth"
    naive = NaiveProcessor(**settings, extractor=PUBLISHED_ORDER if published else extractor)
    processor = Processor(**settings, **({} if name == "truth" else {"extractor": extractor}))
    kind = "frames" if layout == "frames" else "objects"
    given = [demo_input(demo, kind, name) for demo in demos]
    batch = PolicyCollate(processor, 0.0, with_images=True)(given)
    assert_as_when_acting(batch, demos, naive, processor, [demo.prompt for demo in demos])
    # Motions, too: their frames show what was found before and after.
    augmentation = AugmentationConfig(inverse_dynamics_prob=1.0)
    motions = PolicyCollate(processor, 0.0, with_images=True, augmentation=augmentation)(given)
    shown = [
        motion_prompt([demo.observation(t) for t in range(demo.num_steps + 1)], demo.objects)
        for demo in demos
    ]
    assert [len(prompt.images) for prompt in shown] == [demo.num_steps + 1 for demo in demos]
    assert_as_when_acting(motions, demos, naive, processor, shown)


def demo_input(demo, kind: str, name: str) -> Example:
    return Example(preprocess(demo, kind) if name == "truth" else preprocess(demo, kind, EXTRACTORS[name]))


def test_the_noisy_extractor_sometimes_finds_nothing(demonstrations_of_several_steps) -> None:
    """So that the comparison above covers this case."""
    seen = [
        len(NoisyExtractor().in_observation(demo.observation(t)))
        for demo in demonstrations_of_several_steps
        for t in range(demo.num_steps)
    ]
    assert 0 in seen
    assert max(seen) > 1


@pytest.mark.parametrize("layout", ["objects", "views"])
def test_a_prompt_without_detections_keeps_its_words(layout, demonstrations_of_several_steps) -> None:
    blind, demo = EXTRACTORS["noisy"], demonstrations_of_several_steps[0]
    black = {
        name: replace(image, rgb={view: rgb * 0 for view, rgb in image.rgb.items()})
        for name, image in demo.prompt.images.items()
    }
    demo = replace(demo, prompt=replace(demo.prompt, images=black))
    processor = Processor(layout, extractor=blind)
    batch = PolicyCollate(processor, 0.0, with_images=True)([demo_input(demo, "objects", "noisy")])
    assert batch.prompts.crop_index_VS.shape == (2, 0)
    assert_as_when_acting(batch, [demo], NaiveProcessor(layout, extractor=blind), processor, [demo.prompt])


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
