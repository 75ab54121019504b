"""COCO metrics of detectors with known scores, and drawn detections."""

import numpy as np
import pytest
from PIL import Image

from openvima.detector.detection import Detections
from openvima.detector.evaluation import draw_detections, evaluate_detector, save_grid

pytest.importorskip("pycocotools")


class Truthful:
    """Returns the ground truth of the frames in turn, modified by a function."""

    def __init__(self, frames, change=lambda boxes, masks, scores: (boxes, masks, scores)):
        self.frames, self.change = iter(frames), change

    def __call__(self, rgb):
        frame = next(self.frames)
        boxes = frame.boxes.astype(np.int64) - [0, 0, 1, 1]
        return Detections(*self.change(boxes, frame.masks, np.ones(len(boxes))))


@pytest.fixture
def frames(rectangles):
    return [rectangles(seed) for seed in range(6)]


def test_ground_truth_scores_one(frames):
    score = evaluate_detector(Truthful(frames), frames)
    assert (score.frames, score.objects) == (6, 12)
    for precision in (score.boxes, score.masks):
        assert precision.ap == precision.ap50 == precision.ap75 == precision.recall == pytest.approx(1)


@pytest.mark.parametrize("found", [1, 0])
def test_half_of_the_objects_score_half_and_none_zero(frames, found):
    some = Truthful(frames, lambda boxes, masks, scores: (boxes[:found], masks[:found], scores[:found]))
    score = evaluate_detector(some, frames)
    assert score.boxes.recall == pytest.approx(found / 2)
    assert score.boxes.ap50 == pytest.approx(found / 2, abs=0.01)  # COCO's curve has 101 points


def test_boxes_of_iou_two_thirds_count_at_50_and_not_at_75(frames):
    def shortened(boxes, masks, scores):
        boxes = boxes.copy()
        boxes[:, 3] -= np.round((boxes[:, 3] - boxes[:, 1] + 1) / 3).astype(np.int64)
        return boxes, masks, scores

    score = evaluate_detector(Truthful(frames, shortened), frames)
    assert score.boxes.ap50 == pytest.approx(1) and score.boxes.ap75 == 0
    assert score.masks.ap == pytest.approx(1)  # masks are as they were


@pytest.mark.parametrize("background", [0, 255])
def test_ground_truth_boxes_are_visible_on_black_and_on_white(rectangles, background):
    frame = rectangles()
    plain = type(frame)(np.full_like(frame.rgb, background), frame.boxes, frame.masks)
    nothing = Detections(np.zeros((0, 4), np.int64), np.zeros((0, 64, 96), bool), np.zeros(0))
    drawn = np.asarray(draw_detections(plain, nothing))
    for left, upper, right, lower in (3 * plain.boxes).astype(int):
        for line in (drawn[upper, left:right], drawn[lower - 1, left:right], drawn[upper:lower, left]):
            assert 0.3 < (line != background).all(axis=1).mean() < 0.7


def test_images_show_detections_above_the_score(rectangles, tmp_path):
    frame = rectangles()
    boxes = frame.boxes.astype(np.int64) - [0, 0, 1, 1]
    found = Detections(boxes, frame.masks, np.array([0.9, 0.1]))
    image = np.asarray(draw_detections(frame, found))
    plain = np.asarray(draw_detections(frame, found.select(np.zeros(2, bool))))
    assert image.shape == (192, 288, 3)
    assert not np.array_equal(image[:, :140], plain[:, :140])
    assert np.array_equal(image[:, 150:], plain[:, 150:])
    save_grid([draw_detections(frame, found)] * 3, tmp_path / "sheet.png")
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.size == (2 * 296 + 8, 2 * 200 + 8)
