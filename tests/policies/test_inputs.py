"""What networks are given of prompts and observations, and what is refused on the way in."""

from dataclasses import replace

import numpy as np
import pytest

from naive_inputs import PUBLISHED_ORDER, compacted
from openvima.detector.detection import DetectedObjects, Detections
from openvima.errors import PolicyError, PromptError, ShapeError
from openvima.perception.objects import GROUND_TRUTH
from openvima.policies import preset
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.processor import Processor
from openvima.scene import RenderedPrompt
from task_cases import noise

VIEWS = ("front", "top")
FRAMES = {"layout": "frames", "tokens_per_image": 16}


class Scripted:
    """Finds the boxes of a script, one entry a step, the same in both views."""

    def __init__(self, *steps: list[list[int]]) -> None:
        self.steps = [step for step in steps for _ in VIEWS]

    def detect(self, rgb: np.ndarray, view: str) -> Detections:
        return Detections(np.array(self.steps.pop(0), np.int64).reshape(-1, 4))


def seen(**parts: object) -> dict:
    return {"rgb": noise(), "segm": {view: np.ones((128, 256), np.uint8) for view in VIEWS}, "ee": 0, **parts}


LEFT, RIGHT = [20, 60, 40, 80], [200, 60, 220, 80]


def test_fused_slots_follow_what_is_found() -> None:
    extractor = DetectedObjects(Scripted([LEFT, RIGHT], [RIGHT], []))
    processor = Processor("objects", extractor=extractor)
    batches = [processor.encode_observations([[seen()]])[0] for _ in range(2)]
    counts = [batch.masks_BTVN.any(2).sum() for batch in batches]
    assert counts[1] < counts[0]
    with pytest.raises(PolicyError, match=r"contains no object.*min_score"):
        processor.encode_observations([[seen()]])


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


@pytest.mark.parametrize("layout", ["objects", "frames"])
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
        in_order = PUBLISHED_ORDER.in_observation(seen)
        assert (np.diff(in_order.ids) > 0).all()
        for name, expected in (("vima-nano", compacted(in_order)), ("nano", in_order.left_to_right())):
            batch, stack = Processor(*preset(name).inputs).encode_observations([[seen]])
            crops = stack.images()[batch.crop_index_BTVN[0, 0]]
            np.testing.assert_array_equal(crops, expected.crops)
