"""Objects from detectors: a perfect one matches the segmentation, invalid detections are reported."""

from dataclasses import replace

import numpy as np
import pytest

from openvima.detector.detection import DetectedObjects, Detections
from openvima.env import TabletopEnv
from openvima.errors import PolicyError, ShapeError
from openvima.perception.objects import (
    FRONT,
    TOP,
    ObjectViews,
    crop_box,
    observe,
    observe_prompt_image,
)
from openvima.scene import ObjectRecord, PromptImage, RenderedPrompt
from task_cases import REPRESENTATIVE_TASKS, noise

SHAPE = (128, 256)
VIEWS = ("front", "top")


class Fixed:
    """Gives the same detections for every image of a view, and remembers what it was shown."""

    def __init__(self, front: Detections, top: Detections) -> None:
        self.found = {"front": front, "top": top}
        self.shown: list[tuple[np.ndarray, str]] = []

    def detect(self, rgb: np.ndarray, view: str) -> Detections:
        self.shown.append((rgb, view))
        return self.found[view]


def perfect(segm: dict[str, np.ndarray], first: int, *, masks: bool = True) -> Fixed:
    """A detector that knows the segmentation of the one moment that it is asked about."""

    def seen(view: str) -> Detections:
        ids = np.arange(first, 255)
        found = Detections.from_masks(ids[np.isin(ids, segm[view])][:, None, None] == segm[view])
        return found if masks else replace(found, masks=None)

    return Fixed(seen("front"), seen("top"))


def observation(rgb: dict[str, np.ndarray] | None = None) -> dict:
    return {"rgb": rgb or noise(), "ee": 0}


def boxes(*rows: tuple[int, int, int, int]) -> np.ndarray:
    return np.array(rows, np.int64).reshape(-1, 4)


def plain(*rows: tuple[int, int, int, int]) -> Detections:
    return Detections(boxes(*rows))


def prompt_image(kind: str, rgb: dict[str, np.ndarray] | None = None) -> PromptImage:
    segm = {view: np.full(SHAPE, 255, np.uint8) for view in VIEWS}
    return PromptImage("thing", kind, rgb or noise(), segm, (ObjectRecord(2, "bowl", "red"),))


def assert_same(found: ObjectViews, expected: ObjectViews, *, grasps: bool = True) -> None:
    np.testing.assert_array_equal(found.masks, expected.masks)
    np.testing.assert_array_equal(found.boxes, expected.boxes)
    np.testing.assert_array_equal(found.crops, expected.crops)
    if grasps:
        np.testing.assert_array_equal(found.grasps, expected.grasps)


@pytest.mark.parametrize("task", REPRESENTATIVE_TASKS)
def test_a_perfect_detector_finds_what_the_segmentation_says(task: str) -> None:
    """In prompt images but for the order of their records."""
    env = TabletopEnv(task)
    seen, _ = env.reset(seed=0)
    expected = observe(seen)
    for masks in (True, False):
        detector = perfect(seen["segm"], 5 - seen["ee"], masks=masks)
        found = DetectedObjects(detector).in_observation(seen)
        assert_same(found, expected, grasps=masks)
        assert (found.ids == -1).all()
    for image in env.prompt.images.values():
        first = min(record.object_id for record in image.objects)
        found = DetectedObjects(perfect(image.segm, first)).in_prompt_image(image)
        assert_same(found, observe_prompt_image(image).left_to_right())


def test_the_segmentation_is_never_used(starts) -> None:
    _, seen = starts[0]
    extractor = DetectedObjects(perfect(seen["segm"], 5))
    expected = extractor.in_observation(seen)
    for segm in ({}, None, dict.fromkeys(VIEWS, "garbage")):
        assert_same(extractor.in_observation({**seen, "segm": segm}), expected)
    assert_same(extractor.in_observation({key: seen[key] for key in ("rgb", "ee")}), expected)


def test_the_detector_is_shown_both_views_as_they_are() -> None:
    detector, rgb = Fixed(plain(), plain()), noise()
    assert len(DetectedObjects(detector).in_observation(observation(rgb))) == 0
    assert [view for _, view in detector.shown] == ["front", "top"]
    for shown, view in detector.shown:
        np.testing.assert_array_equal(shown, rgb[view])


def test_crops_and_boxes_follow_from_the_detected_boxes_alone() -> None:
    rgb = noise()
    found = DetectedObjects(Fixed(plain(), plain((10, 20, 40, 70)))).in_observation(observation(rgb))
    crop, box = crop_box(rgb["top"], (10, 40, 20, 70))
    np.testing.assert_array_equal(found.crops[TOP, 0], crop)
    np.testing.assert_array_equal(found.boxes[TOP, 0], box)
    np.testing.assert_array_equal(found.grasps[TOP, 0], [25, 45])
    assert found.masks.tolist() == [[False], [True]]
    assert not found.crops[FRONT].any()
    assert not found.boxes[FRONT].any()


def test_the_grasp_point_is_the_most_interior_pixel_of_the_mask_or_else_the_centre_of_the_box() -> None:
    mask = np.zeros((2, *SHAPE), bool)
    mask[0, 20:31, 10:21] = True
    mask[0, 25, 10:100] = True
    top = Detections(boxes((10, 20, 99, 30), (200, 20, 210, 30)), masks=mask)
    found = DetectedObjects(Fixed(plain(), top)).in_observation(observation())
    assert found.grasps[TOP].tolist() == [[15, 25], [205, 25]]


@pytest.mark.parametrize(
    ("front", "masks"),
    [
        ((100, 70, 120, 90), [[True], [True]]),
        ((100, 50, 120, 90), [[True], [True]]),  # the upper edge depends on the object's height
        ((200, 70, 220, 90), [[False, True], [True, False]]),  # each is hidden in one view
    ],
)
def test_boxes_on_the_same_place_of_the_table_are_one_object(front, masks) -> None:
    found = DetectedObjects(Fixed(plain(front), plain((100, 86, 120, 106)))).in_observation(observation())
    assert found.masks.tolist() == masks


@pytest.mark.parametrize("step", [None, 2])
def test_of_objects_in_one_place_those_of_one_colour_or_pattern_belong_together(step: int | None) -> None:
    """A red and a green one; or stripes and a plain colour with the same mean."""
    rgb = {view: np.zeros((3, *SHAPE), np.uint8) for view in VIEWS}
    behind = (0, 254) if step else (0, 255)
    ahead = (0, 127) if step else (1, 255)
    for view, rows in (("front", ((60, 75), (76, 91))), ("top", ((86, 100), (101, 107)))):
        # In the top view the one ahead is farther from its place in the front view than the one behind.
        for (channel, level), (first, last), stride in zip((behind, ahead), rows, (step, None), strict=True):
            rgb[view][channel, first:last, 100:121:stride] = level
    front = plain((100, 60, 120, 74), (100, 76, 120, 90))
    top = plain((100, 86, 120, 99), (100, 101, 120, 106))
    found = DetectedObjects(Fixed(front, top)).in_observation(observation(rgb))
    assert found.masks.all()
    kinds = found.crops.max(axis=(2, 3, 4)) > 200 if step else found.crops.max(axis=(3, 4)) > 0
    np.testing.assert_array_equal(kinds[FRONT], kinds[TOP])


def test_detections_of_low_score_are_left_out() -> None:
    rows = boxes((10, 10, 20, 20), (50, 10, 60, 20), (90, 10, 99, 20))
    detector = Fixed(plain(), Detections(rows, scores=np.array([0.9, 0.3, 0.5])))
    columns = [
        DetectedObjects(detector, min_score=score).in_observation(observation()).boxes[TOP, :, 0].tolist()
        for score in (0.5, 0.2, 1.0)
    ]
    assert columns == [[15, 94], [15, 55, 94], []]


def test_an_image_of_one_object_keeps_the_highest_score_even_below_the_threshold() -> None:
    rows = boxes((10, 10, 20, 20), (150, 10, 160, 20))
    front, top = (Detections(rows, scores=np.array(scores)) for scores in ([0.1, 0.2], [0.9, 0.8]))
    extractor = DetectedObjects(Fixed(front, top))
    found = extractor.in_prompt_image(prompt_image("object"))
    assert found.boxes[:, :, 0].tolist() == [[155], [15]]
    assert len(extractor.in_prompt_image(prompt_image("scene"))) == 2


class Bright:
    """Detects one box as far from the left border as the image is bright, in several images at once."""

    def __init__(self) -> None:
        self.batches: list[int] = []

    def detect(self, rgb: np.ndarray, view: str) -> Detections:
        raise AssertionError("both views are detected together")

    def detect_batch(self, frames: list[np.ndarray]) -> list[Detections]:
        self.batches.append(len(frames))
        return [plain((int(rgb[0, 0, 0]), 60, int(rgb[0, 0, 0]) + 20, 80)) for rgb in frames]


def bright(level: int) -> dict[str, np.ndarray]:
    return {view: np.full((3, *SHAPE), level, np.uint8) for view in VIEWS}


def test_images_announced_ahead_are_detected_in_batches_and_give_the_same_objects() -> None:
    observations = [observation(bright(level)) for level in (0, 10, 20, 30, 10)]
    images = [prompt_image(kind, bright(level)) for kind, level in (("object", 40), ("scene", 20))]
    detector = Bright()
    ahead, alone = DetectedObjects(detector, cache_size=9), DetectedObjects(Bright())
    ahead.extract_ahead(observations, images)
    assert detector.batches == [8, 2]  # the equal observations and the scene like one of them count once
    for each in observations:
        assert_same(ahead.in_observation(each), alone.in_observation(each))
    for image in images:
        assert_same(ahead.in_prompt_image(image), alone.in_prompt_image(image))
    assert detector.batches == [8, 2]


def test_an_extractor_is_told_ahead_of_the_images_of_a_batch() -> None:
    from openvima.policies.processor import Processor

    detector = Bright()
    processor = Processor("objects", extractor=DetectedObjects(detector, cache_size=9))
    text = "Put the {thing} into the {thing}."
    prompts = [RenderedPrompt(text, {"thing": prompt_image("object", bright(level))}) for level in (10, 20)]
    _, stack = processor.encode_prompts(prompts)
    assert detector.batches == [4]
    processor.encode_observations([[observation(bright(level))] for level in (30, 40, 50)], stack=stack)
    assert detector.batches == [4, 6]


def test_boxes_in_real_numbers_take_in_every_pixel_they_touch() -> None:
    edges = np.array([[10.0, 20.0, 11.0, 22.0], [10.4, 19.9, 30.1, 40.0], [-5.0, -1.0, 300.0, 200.0]])
    found = Detections.from_edges(edges)
    assert found.boxes.tolist() == [[10, 20, 10, 21], [10, 19, 30, 39], [0, 0, 255, 127]]
    assert found.boxes.dtype == np.int64


def test_boxes_are_drawn_around_masks_and_specks_left_out() -> None:
    masks = np.zeros((3, *SHAPE), bool)
    masks[0, 5:8, 10:30] = True
    masks[1, 5, 10] = True
    masks[2, 127, 254:] = True
    found = Detections.from_masks(masks, np.array([0.1, 0.2, 0.3]))
    assert found.boxes.tolist() == [[10, 5, 29, 7], [254, 127, 255, 127]]
    assert found.scores.tolist() == [0.1, 0.3]
    assert len(Detections.from_masks(masks[:0])) == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Detections(np.zeros((2, 4))), "float64.*from_edges"),
        (lambda: Detections(np.zeros((2, 5), int)), r"\(2, 5\).*\(N, 4\)"),
        (lambda: Detections([[1, 2, 3, 4]]), "boxes are list.*an array of integers"),
        (lambda: Detections(boxes((5, 5, 4, 9))), r"box 0 is \[5, 5, 4, 9\]"),
        (lambda: Detections(boxes(), masks=np.zeros((0, 8, 8))), "masks are float64"),
        (lambda: Detections(boxes(), scores=np.zeros(3)), r"scores are float64 \(3,\)"),
        (lambda: Detections(boxes((1, 1, 2, 2)), scores=np.array([np.nan])), "finite"),
        (lambda: Detections.from_edges(np.zeros(4)), "left, upper, right, lower"),
        (lambda: Detections.from_edges(np.array([[256.0, 0, 300, 9]])), "outside"),
        (lambda: Detections.from_edges(np.array([[9.0, 9.0, 20.0, 5.0]])), "ends before"),
    ],
)
def test_impossible_detections_are_refused_at_once(make, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        make()


@pytest.mark.parametrize(
    ("found", "error", "message"),
    [
        (plain((0, 0, 256, 9)), ShapeError, r"box 0 of view 'front'.*0 … 255.*0 … 127"),
        (plain((0, 0, 9, 9), (0, -1, 9, 9)), ShapeError, "box 1 of view 'front'"),
        (Detections(boxes((0, 0, 9, 9)), np.ones((1, 64, 64), bool)), ShapeError, r"not \(N, 128, 256\)"),
        (boxes((0, 0, 9, 9)), PolicyError, "returned a ndarray for view 'front'"),
    ],
)
def test_detections_that_do_not_fit_the_image_are_refused(found, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        DetectedObjects(Fixed(found, plain())).in_observation(observation())
