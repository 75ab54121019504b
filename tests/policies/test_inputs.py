"""What networks are given of prompts and observations, and what is refused on the way in."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from openvima.errors import PolicyError, PromptError, ShapeError  # noqa: E402
from openvima.perception.objects import GROUND_TRUTH, GroundTruth  # noqa: E402
from openvima.policies import preset  # noqa: E402
from openvima.policies.detection import DetectedObjects, Detections  # noqa: E402
from openvima.policies.inference import NetworkPolicy  # noqa: E402
from openvima.policies.inputs import Reader  # noqa: E402
from openvima.policies.network import build_network  # noqa: E402
from openvima.scene import RenderedPrompt  # noqa: E402

VIEWS = ("front", "top")
FRAMES = {"layout": "frames", "image_size": (64, 128), "tokens_per_frame_pair": 16}


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


def crowded(count: int) -> dict:
    """An observation of so many objects, of four pixels each."""
    segm = np.ones((128, 256), np.uint8)
    for number in range(count):
        row, column = number // 32 * 4, number % 32 * 8
        segm[row : row + 2, column : column + 2] = 5 + number
    return seen(segm=dict.fromkeys(VIEWS, segm))


LEFT, RIGHT = [20, 60, 40, 80], [200, 60, 220, 80]


def test_slots_of_a_missed_object_are_kept_black_at_the_end_of_each_view() -> None:
    extractor = DetectedObjects(Scripted([LEFT, RIGHT], [RIGHT], [], [LEFT, RIGHT]))
    episode = Reader("views", extractor=extractor).begin_episode()
    steps = [episode.read_step(seen()).objects for _ in range(4)]
    assert [len(step) for step in steps] == [len(steps[0])] * 4
    both, missed, none, again = steps
    for view in range(2):
        assert missed.masks[view].sum() == 1
        assert missed.masks[view, 0]
        np.testing.assert_array_equal(missed.boxes[view, 0], both.boxes[view, both.masks[view]][-1])
        assert not missed.crops[view, 1:].any()
        assert not missed.boxes[view, 1:].any()
    assert not none.masks.any()
    assert not none.crops.any()
    np.testing.assert_array_equal(again.crops, both.crops)
    np.testing.assert_array_equal(again.masks, both.masks)


def test_fused_slots_follow_what_is_found() -> None:
    extractor = DetectedObjects(Scripted([LEFT, RIGHT], [RIGHT], []))
    episode = Reader("objects", extractor=extractor).begin_episode()
    counts = [episode.read_step(seen()).objects.visible().sum() for _ in range(2)]
    assert counts[1] < counts[0]
    with pytest.raises(PolicyError, match=r"shows no object.*min_score"):
        episode.read_step(seen())


@pytest.mark.parametrize("layout", ["objects", "views"])
def test_a_first_observation_without_objects_is_refused(layout: str) -> None:
    with pytest.raises(PolicyError, match="shows no object"):
        Reader(layout).begin_episode().read_step(seen())


def test_detected_objects_act(small_sizes, demonstrations) -> None:
    """A policy that acts on detections neither needs nor reads a segmentation."""
    demo = demonstrations[0]
    extractor = DetectedObjects(Scripted([LEFT, RIGHT]), prompt_extractor=GROUND_TRUTH)
    policy = NetworkPolicy(build_network(small_sizes, seed=0), extractor=extractor)
    policy.reset([demo.prompt])
    first = demo.observation(0)
    (action,) = policy.act([{key: first[key] for key in ("rgb", "ee")}])
    assert all(np.isfinite(value).all() for value in action.values())


@pytest.mark.parametrize("layout", ["objects", "views", "frames"])
@pytest.mark.parametrize("effector", [2, -1, 0.5, None])
def test_an_end_effector_that_does_not_exist_is_refused(layout: str, effector: object) -> None:
    reader = Reader(**FRAMES) if layout == "frames" else Reader(layout)
    with pytest.raises(PolicyError, match=r"0 \(suction\) or 1 \(spatula\)"):
        reader.begin_episode().read_step(seen(ee=effector))


@pytest.mark.parametrize("part", ["rgb", "ee"])
def test_a_missing_part_of_an_observation_is_named(part: str) -> None:
    observation = seen()
    del observation[part]
    for reader in (Reader("objects"), Reader(**FRAMES)):
        with pytest.raises(PolicyError, match=f"no '{part}'"):
            reader.begin_episode().read_step(observation)


def test_frames_need_no_segmentation() -> None:
    observation = seen()
    del observation["segm"]
    step = Reader(**FRAMES).begin_episode().read_step(observation)
    assert step.objects.crops.shape == (2, 1, 3, 64, 128)


def test_frames_of_another_size_are_refused() -> None:
    reader = Reader(**FRAMES)
    with pytest.raises(ShapeError, match=r"\(3, 256, 512\); this policy takes those of \(3, 128, 256\)"):
        reader.begin_episode().read_step(seen(rgb=noise(shape=(256, 512))))
    with pytest.raises(ShapeError, match="even height and width"):
        reader.begin_episode().read_step(seen(rgb=noise(shape=(127, 256))))


@pytest.mark.parametrize("layout", ["objects", "views", "frames"])
def test_prompts_that_do_not_fit_together_are_refused(layout: str, demonstrations) -> None:
    reader = Reader(**FRAMES) if layout == "frames" else Reader(layout)
    prompt = demonstrations[0].prompt
    name = next(iter(prompt.images))
    without = {key: image for key, image in prompt.images.items() if key != name}
    for text in ("", "   "):
        with pytest.raises(PromptError, match="empty; it must hold at least one word or image"):
            reader.read_prompt(RenderedPrompt(text, {}))
    with pytest.raises(PromptError, match=f"names images.*{name}.*but got"):
        reader.read_prompt(RenderedPrompt(prompt.text, without))
    with pytest.raises(PromptError, match="names images"):
        reader.read_prompt(RenderedPrompt("put it down.", prompt.images))
    image = prompt.images[name]
    blind = replace(image, rgb={"front": image.rgb["front"]})
    with pytest.raises(PolicyError, match="lacks the view top"):
        reader.read_prompt(replace(prompt, images={**prompt.images, name: blind}))
    real = replace(image, rgb={view: frame / 255 for view, frame in image.rgb.items()})
    with pytest.raises(ShapeError, match=r"float64.*must be uint8"):
        reader.read_prompt(replace(prompt, images={**prompt.images, name: real}))


@pytest.mark.parametrize("name", ["nano", "vima-nano"])
def test_more_objects_than_a_history_holds_are_refused(name: str, demonstrations) -> None:
    """With one token for each object two steps of 250 fit, with one for each view only one."""
    demo = demonstrations[0]
    policy = NetworkPolicy(build_network(preset(name), seed=0))
    policy.reset([demo.prompt])
    with pytest.raises(PolicyError, match=r"this policy takes 512\. Give.*fewer objects"):
        for _ in range(3):
            policy.act([crowded(250)])


def test_objects_come_in_the_order_of_their_ids_where_published_policies_know_it(starts) -> None:
    for _, seen in starts:
        in_order = GroundTruth(left_to_right=False).in_observation(seen)
        assert (np.diff(in_order.ids) > 0).all()
        step = Reader.of(preset("vima-nano").images).begin_episode().read_step(seen)
        np.testing.assert_array_equal(step.objects.crops, in_order.compacted().crops)
        step = Reader.of(preset("nano").images).begin_episode().read_step(seen)
        np.testing.assert_array_equal(step.objects.ids, in_order.left_to_right().ids)
