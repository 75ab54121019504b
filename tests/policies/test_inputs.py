"""What networks are given of prompts and observations, and what is refused on the way in."""

from dataclasses import replace

import numpy as np
import pytest

from openvima.detector.detection import DetectedObjects, Detections
from openvima.errors import PolicyError, PromptError, ShapeError
from openvima.perception.objects import GROUND_TRUTH, GroundTruth, ObjectViews, make_hidden_objects
from openvima.policies import preset
from openvima.policies.batch import WORD, PromptBatch
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.processor import Processor
from openvima.scene import PromptImage, RenderedPrompt

VIEWS = ("front", "top")
FRAMES = {"layout": "frames", "image_size": (64, 128), "tokens_per_image": 16}


class Scripted:
    """Finds the boxes of a script, one entry a step, the same in both views."""

    def __init__(self, *steps: list[list[int]]) -> None:
        self.steps = [step for step in steps for _ in VIEWS]

    def detect(self, rgb: np.ndarray, view: str) -> Detections:
        return Detections(np.array(self.steps.pop(0), np.int64).reshape(-1, 4))


def noise(seed: int = 0, shape: tuple[int, int] = (128, 256)) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {view: rng.integers(0, 256, (3, *shape), dtype=np.uint8) for view in VIEWS}


def seen(**parts: object) -> dict:
    return {"rgb": noise(), "segm": {view: np.ones((128, 256), np.uint8) for view in VIEWS}, "ee": 0, **parts}


LEFT, RIGHT = [20, 60, 40, 80], [200, 60, 220, 80]


def test_slots_of_a_missed_object_are_kept_black_at_the_end_of_each_view() -> None:
    extractor = DetectedObjects(Scripted([LEFT, RIGHT], [RIGHT], [], [LEFT, RIGHT]))
    processor = Processor("views", extractor=extractor)
    steps, num_slots = [], None
    for _ in range(4):
        batch, stack = processor.encode_observations([[seen()]], num_slots)
        num_slots = batch.num_slots_BT[:, -1].tolist()
        crops = stack.images()[batch.crop_index_BTVN[0, 0]]
        steps.append((num_slots, crops, batch.masks_BTVN[0, 0].numpy(), batch.boxes_BTVN4[0, 0].numpy()))
    assert [slots for slots, *_ in steps] == [steps[0][0]] * 4
    both, missed, none, again = ((crops, masks, boxes) for _, crops, masks, boxes in steps)
    for view in range(2):
        crops, masks, boxes = (array[view] for array in missed)
        assert masks.sum() == 1
        assert masks[0]
        np.testing.assert_array_equal(boxes[0], both[2][view, both[1][view]][-1])
        assert not crops[1:].any()
        assert not boxes[1:].any()
    assert not none[1].any()
    assert not none[0].any()
    np.testing.assert_array_equal(again[0], both[0])
    np.testing.assert_array_equal(again[1], both[1])


def test_fused_slots_follow_what_is_found() -> None:
    extractor = DetectedObjects(Scripted([LEFT, RIGHT], [RIGHT], []))
    processor = Processor("objects", extractor=extractor)
    batches = [processor.encode_observations([[seen()]])[0] for _ in range(2)]
    counts = [batch.masks_BTVN.any(2).sum() for batch in batches]
    assert counts[1] < counts[0]
    with pytest.raises(PolicyError, match=r"contains no object.*min_score"):
        processor.encode_observations([[seen()]])


@pytest.mark.parametrize("layout", ["objects", "views"])
def test_a_first_observation_without_objects_is_refused(layout: str) -> None:
    with pytest.raises(PolicyError, match="contains no object"):
        Processor(layout).encode_observations([[seen()]])


def test_detected_objects_act(small_sizes, demonstrations) -> None:
    """A policy that acts on detections neither needs nor reads a segmentation."""
    demo = demonstrations[0]
    extractor = DetectedObjects(Scripted([LEFT, RIGHT]), prompt_extractor=GROUND_TRUTH)
    policy = NetworkPolicy(build_network(small_sizes, seed=0), extractor=extractor)
    policy.reset([demo.prompt])
    first = demo.observation(0)
    (action,) = policy.act([{key: first[key] for key in ("rgb", "ee")}])
    assert all(np.isfinite(value).all() for value in action.values())


def test_frames_need_no_segmentation() -> None:
    observation = seen()
    del observation["segm"]
    batch, stack = Processor(**FRAMES).encode_observations([[observation]])
    assert stack.images()[batch.crop_index_BTVN[0, 0]].shape == (2, 1, 3, 64, 128)


@pytest.mark.parametrize("layout", ["objects", "views", "frames"])
def test_prompts_that_do_not_fit_together_are_refused(layout: str, demonstrations) -> None:
    processor = Processor(**FRAMES) if layout == "frames" else Processor(layout)
    prompt = demonstrations[0].prompt
    name = next(iter(prompt.images))
    without = {key: image for key, image in prompt.images.items() if key != name}
    for text in ("", "   "):
        with pytest.raises(PromptError, match="empty; it must hold at least one word or image"):
            processor.encode_prompts([RenderedPrompt(text, {})])
    with pytest.raises(PromptError, match=f"names images.*{name}.*but got"):
        processor.encode_prompts([RenderedPrompt(prompt.text, without)])
    with pytest.raises(PromptError, match="names images"):
        processor.encode_prompts([RenderedPrompt("put it down.", prompt.images)])
    image = prompt.images[name]
    blind = replace(image, rgb={"front": image.rgb["front"]})
    with pytest.raises(PolicyError, match="lacks the view top"):
        processor.encode_prompts([replace(prompt, images={**prompt.images, name: blind})])
    real = replace(image, rgb={view: frame / 255 for view, frame in image.rgb.items()})
    with pytest.raises(ShapeError, match=r"float64.*must be uint8"):
        processor.encode_prompts([replace(prompt, images={**prompt.images, name: real})])


def test_objects_come_in_the_order_of_their_ids_where_published_policies_know_it(starts) -> None:
    for _, seen in starts:
        in_order = GroundTruth(left_to_right=False).in_observation(seen)
        assert (np.diff(in_order.ids) > 0).all()
        for name, expected in (("vima-nano", in_order.compact()), ("nano", in_order.left_to_right())):
            batch, stack = Processor.of(preset(name).inputs).encode_observations([[seen]])
            crops = stack.images()[batch.crop_index_BTVN[0, 0]]
            np.testing.assert_array_equal(crops, expected.crops)


class ScriptedPromptSlots:
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
    batch, _ = Processor("views", extractor=ScriptedPromptSlots()).encode_prompts([prompt])
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
