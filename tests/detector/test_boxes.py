"""Box IoU, regression targets and NMS against hand-computed cases and naive implementations."""

import math

import numpy as np
import pytest
import torch

import naive
from openvima.detector.boxes import (
    box_iou,
    cell_anchors,
    clip_boxes,
    decode_boxes,
    encode_boxes,
    level_anchors,
    match,
    nms,
    pyramid_anchors,
    subsample,
)

ROI_WEIGHTS = (10.0, 10.0, 5.0, 5.0)


def random_boxes(count: int, seed: int = 0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    low = rng.uniform(0, 60, (count, 2))
    return torch.from_numpy(np.concatenate([low, low + rng.uniform(1, 40, (count, 2))], axis=1))


def test_iou_of_small_boxes():
    boxes = torch.tensor([[0.0, 0, 2, 2], [1, 1, 3, 3], [2, 0, 4, 2], [0, 0, 2, 1], [5, 5, 5, 9]])
    expected = [1, 1 / 7, 0, 1 / 2, 0]
    assert box_iou(boxes[:1], boxes)[0].tolist() == pytest.approx(expected)


def test_iou_agrees_with_the_naive_twin():
    first, second = random_boxes(30), random_boxes(20, 1)
    expected = [[naive.box_iou(a, b) for b in second.tolist()] for a in first.tolist()]
    assert np.allclose(box_iou(first, second), expected, atol=1e-12)


def test_regression_targets_of_a_small_case():
    reference, box = torch.tensor([10.0, 20, 30, 60]), torch.tensor([20.0, 10, 60, 50])
    # centres (20, 40) and (40, 30), sizes (20, 40) and (40, 40)
    expected = [20 / 20, -10 / 40, math.log(2), 0.0]
    assert encode_boxes(box, reference, (1.0, 1.0, 1.0, 1.0)).tolist() == pytest.approx(expected)
    weighted = [10.0, -2.5, 5 * math.log(2), 0.0]
    assert encode_boxes(box, reference, ROI_WEIGHTS).tolist() == pytest.approx(weighted)


def test_coding_agrees_with_the_naive_twin_and_is_undone_by_decoding():
    boxes, references = random_boxes(50), random_boxes(50, 1)
    deltas = encode_boxes(boxes, references, ROI_WEIGHTS)
    pairs = zip(boxes.tolist(), references.tolist(), strict=True)
    assert np.allclose(deltas, [naive.encode(a, b, ROI_WEIGHTS) for a, b in pairs], atol=1e-9)
    assert torch.allclose(decode_boxes(deltas, references, ROI_WEIGHTS, height=200, width=200), boxes)


def test_the_growth_of_a_box_is_limited():
    deltas, box = torch.tensor([0.0, 0, 500, 0]), torch.tensor([600.0, 0, 616, 16])
    grown = decode_boxes(deltas, box, (1.0,) * 4, height=2000, width=2000)
    assert float(grown[2] - grown[0]) == pytest.approx(1000)


def test_decoded_boxes_are_clipped_to_the_image():
    deltas, box = torch.tensor([[0.0, 0, 1, 0]]), torch.tensor([[0.0, 2, 16, 18]])
    assert decode_boxes(deltas, box, (1.0,) * 4, height=10, width=20).tolist() == [[0, 2, 20, 10]]


def test_boxes_are_clipped_to_the_image():
    assert clip_boxes(torch.tensor([[-3.0, 2, 40, 50]]), height=20, width=30).tolist() == [[0, 2, 30, 20]]


def test_of_three_boxes_in_a_chain_the_middle_one_goes():
    # The second overlaps both others by more than a third; it goes, and the third one stays.
    boxes = torch.tensor([[0.0, 0, 10, 10], [4, 0, 14, 10], [8, 0, 18, 10]])
    assert nms(boxes, torch.tensor([0.9, 0.8, 0.7]), 0.3).tolist() == [0, 2]
    assert nms(boxes, torch.tensor([0.8, 0.9, 0.7]), 0.3).tolist() == [1]


@pytest.mark.parametrize("limit", [0.0, 0.1, 0.3, 0.5, 0.7])
@pytest.mark.parametrize("seed", range(5))
def test_nms_agrees_with_the_naive_twin(limit, seed):
    rng = np.random.default_rng(seed)
    boxes = random_boxes(80, seed)
    scores = rng.integers(0, 20, 80) / 20  # with ties
    kept = nms(boxes, torch.from_numpy(scores), limit)
    assert kept.tolist() == naive.nms(boxes.tolist(), scores.tolist(), limit, [0] * 80)


def test_nms_acts_in_each_group_alone_and_drops_boxes_without_area():
    boxes = torch.tensor([[0.0, 0, 10, 10], [0, 0, 10, 10], [0, 0, 10, 10], [5, 5, 5, 9]])
    scores, groups = torch.tensor([0.7, 0.8, 0.9, 1.0]), torch.tensor([0, 1, 0, 1])
    assert nms(boxes, scores, 0.5, groups).tolist() == [2, 1]


def test_nms_of_no_boxes_is_empty():
    assert nms(torch.zeros(0, 4), torch.zeros(0), 0.5).tolist() == []


def test_the_anchors_of_a_cell_have_one_area_and_three_shapes():
    # sizes 8 · √2 by 8 / √2, 8 by 8, 8 / √2 by 8 · √2
    long, short = 4 * 2**0.5, 2 * 2**0.5
    expected = [[-long, -short, long, short], [-4, -4, 4, 4], [-short, -long, short, long]]
    assert np.allclose(cell_anchors(8.0), expected)


def test_the_anchors_of_a_level_agree_with_the_naive_twin():
    made = level_anchors(20.0, stride=8, height=3, width=5)
    assert np.allclose(made, naive.anchors(20.0, stride=8, height=3, width=5), atol=1e-5)


def test_strides_double_from_level_to_level():
    first, second = pyramid_anchors((16.0, 32.0), [(2, 4), (1, 2)], first_stride=4)
    assert np.allclose(first, naive.anchors(16.0, stride=4, height=2, width=4), atol=1e-5)
    assert np.allclose(second, naive.anchors(32.0, stride=8, height=1, width=2), atol=1e-5)


OBJECTS = torch.tensor([[0.0, 0, 10, 10], [50, 50, 60, 60]])


def test_boxes_are_foreground_background_or_ignored():
    boxes = torch.tensor(
        [[0.0, 0, 10, 8], [0, 0, 10, 5], [0, 0, 5, 4], [50, 50, 61, 60]]
    )  # 0.8, 0.5, 0.2, 0.91
    numbers, labels = match(boxes, OBJECTS, low=0.3, high=0.7)
    assert labels.tolist() == [1, -1, 0, 1]
    assert numbers.tolist() == [0, 0, 0, 1]


def test_low_quality_matches_label_the_best_boxes_of_each_object():
    boxes = torch.tensor([[0.0, 0, 10, 2], [0, 0, 2, 10], [0, 0, 1, 1], [50, 50, 60, 60]])
    _, labels = match(boxes, OBJECTS, low=0.3, high=0.7, allow_low_quality=True)
    assert labels.tolist() == [1, 1, 0, 1]


def test_without_objects_everything_is_background():
    numbers, labels = match(OBJECTS, torch.zeros(0, 4), low=0.3, high=0.7, allow_low_quality=True)
    assert numbers.tolist() == labels.tolist() == [0, 0]


def test_an_object_without_intersecting_box_matches_none():
    _, labels = match(OBJECTS[:1], OBJECTS[1:], low=0.3, high=0.7, allow_low_quality=True)
    assert labels.tolist() == [0]


def test_boxes_are_sampled_with_a_fraction_of_foreground():
    labels = torch.tensor([1] * 10 + [0] * 50 + [-1] * 5)
    draw = lambda seed: subsample(  # noqa: E731
        labels, count=20, positive_fraction=0.25, generator=torch.Generator().manual_seed(seed)
    )
    positive, negative = draw(0)
    assert (labels[positive] == 1).all() and (labels[negative] == 0).all()
    assert (len(positive), len(negative)) == (5, 15)
    assert torch.equal(draw(0)[1], negative) and not torch.equal(draw(1)[1], negative)


def test_background_replaces_missing_foreground():
    labels = torch.tensor([1] + [0] * 50)
    positive, negative = subsample(labels, count=20, positive_fraction=0.5, generator=torch.Generator())
    assert (len(positive), len(negative)) == (1, 19)
