"""Boxes: proposals of the network, overlaps, alignment."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import naive
from openvima.detector.boxes import (
    box_iou,
    decode_boxes,
    encode_boxes,
    match,
    nms,
    pyramid_anchors,
    subsample,
)
from openvima.detector.config import SMALL
from openvima.detector.layers import PROPOSAL_WEIGHTS, AnchorPredictions, RegionProposalNetwork
from openvima.detector.roi_align import (
    box_levels,
    crop_masks,
    paste_masks,
    pyramid_align,
    roi_align,
)

HEIGHT, WIDTH = 64, 96


def scored(tiny, seed: int) -> AnchorPredictions:
    """Predictions on two levels of two images, with many equal scores."""
    torch.manual_seed(seed)
    levels = [torch.randn(2, 16, HEIGHT // stride, WIDTH // stride) for stride in (4, 8)]
    with torch.no_grad():
        predictions = RegionProposalNetwork(tiny)(levels)
        return [
            (anchors, (scores * 40).round(), torch.randn_like(deltas))
            for anchors, scores, deltas in predictions
        ]


def propose(config, given: AnchorPredictions) -> list[torch.Tensor]:
    return RegionProposalNetwork(config).propose(given, height=HEIGHT, width=WIDTH)


@pytest.mark.parametrize("seed", range(3))
def test_proposals_agree_with_sequential_nms_per_level(tiny, seed):
    config, given = replace(tiny, rpn_pre_nms_top_n=40, rpn_post_nms_top_n=50), scored(tiny, seed)
    for image, proposed in enumerate(propose(config, given)):
        boxes, scores, levels = [], [], []
        for level, (anchors, objectness, deltas) in enumerate(given):
            best, rows = objectness[image].topk(40)
            boxes += decode_boxes(
                deltas[image, rows], anchors[rows], PROPOSAL_WEIGHTS, height=HEIGHT, width=WIDTH
            ).tolist()
            scores += best.tolist()
            levels += [level] * 40
        solid = [n for n, box in enumerate(boxes) if box[2] > box[0] and box[3] > box[1]]
        boxes, scores, levels = ([values[n] for n in solid] for values in (boxes, scores, levels))
        kept = naive.nms(boxes, scores, config.rpn_nms_iou, levels)[:50]
        assert proposed.tolist() == [boxes[number] for number in kept]


ROI_WEIGHTS = (10.0, 10.0, 5.0, 5.0)


def random_boxes(count: int, seed: int = 0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    low = rng.uniform(0, 60, (count, 2))
    return torch.from_numpy(np.concatenate([low, low + rng.uniform(1, 40, (count, 2))], axis=1))


def test_iou_agrees_with_the_naive_twin():
    first, second = random_boxes(30), random_boxes(20, 1)
    expected = [[naive.box_iou(a, b) for b in second.tolist()] for a in first.tolist()]
    assert np.allclose(box_iou(first, second), expected, atol=1e-12)


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


@pytest.mark.parametrize(("seed", "limit"), [*enumerate((0.0, 0.1, 0.3, 0.5, 0.7))])
def test_nms_agrees_with_the_naive_twin(limit, seed):
    rng = np.random.default_rng(seed)
    boxes = random_boxes(80, seed)
    scores = rng.integers(0, 20, 80) / 20  # with ties
    kept = nms(boxes, torch.from_numpy(scores), limit, torch.zeros(80, dtype=torch.int64))
    assert kept.tolist() == naive.nms(boxes.tolist(), scores.tolist(), limit, [0] * 80)


def test_nms_acts_in_each_group_alone_and_drops_boxes_without_area():
    boxes = torch.tensor([[0.0, 0, 10, 10], [0, 0, 10, 10], [0, 0, 10, 10], [5, 5, 5, 9]])
    scores, groups = torch.tensor([0.7, 0.8, 0.9, 1.0]), torch.tensor([0, 1, 0, 1])
    assert nms(boxes, scores, 0.5, groups).tolist() == [2, 1]


def test_the_anchors_of_a_level_agree_with_the_naive_twin():
    _, made = pyramid_anchors((10.0, 20.0), ((6, 10), (3, 5)))
    assert np.allclose(made, naive.anchors(20.0, stride=8, height=3, width=5), atol=1e-5)


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


def test_an_object_without_intersecting_box_matches_none() -> None:
    numbers, labels = match(OBJECTS, torch.zeros(0, 4), low=0.3, high=0.7, allow_low_quality=True)
    assert numbers.tolist() == labels.tolist() == [0, 0]
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
    labels = torch.tensor([1] + [0] * 50)  # background replaces missing foreground
    positive, negative = subsample(labels, count=20, positive_fraction=0.5, generator=torch.Generator())
    assert (len(positive), len(negative)) == (1, 19)


def test_the_pyramid_level_follows_from_the_size_of_a_box():
    sides = torch.tensor([5.0, 23.9, 24, 47.9, 48, 96, 500])
    boxes = torch.stack([sides * 0, sides * 0, sides, sides], dim=1)
    levels = box_levels(boxes, SMALL)
    assert levels.tolist() == [0, 0, 0, 0, 1, 2, 2]


def test_pasted_masks_agree_with_the_naive_twin():
    rng = np.random.default_rng(0)
    probabilities = rng.uniform(0, 1, (6, 5, 5))
    low = rng.uniform(-4, 20, (6, 2))
    boxes = np.concatenate([low, low + rng.uniform(0.5, 15, (6, 2))], axis=1)
    pasted = paste_masks(torch.from_numpy(probabilities), torch.from_numpy(boxes), height=24, width=30)
    for number, box in enumerate(boxes.tolist()):
        expected = naive.paste(probabilities[number], tuple(box), height=24, width=30)
        assert np.array_equal(pasted[number].numpy(), expected)


def test_cropping_and_pasting_keeps_a_mask():
    mask = torch.zeros(1, 40, 50, dtype=torch.bool)
    mask[0, 10:30, 5:15] = True
    mask[0, 20:30, 5:35] = True
    box = torch.tensor([[5.0, 10, 35, 30]])
    cells = crop_masks(mask, box, size=28)
    again = paste_masks(cells.float(), box, height=40, width=50)
    assert (again & mask).sum() / (again | mask).sum() > 0.95


@pytest.mark.parametrize("sampling_ratio", [0, 1, 2, 3])
def test_aligned_features_agree_with_the_naive_twin(sampling_ratio):
    rng = np.random.default_rng(sampling_ratio)
    levels = [torch.from_numpy(rng.normal(size=(2, 3, 16 // 2**k, 24 // 2**k))) for k in range(3)]
    low = rng.uniform(-20, 80, (20, 2))
    boxes = torch.from_numpy(np.concatenate([low, low + rng.uniform(0.1, 120, (20, 2))], axis=1))
    config = replace(SMALL, canonical_size=30.0, roi_sampling_ratio=sampling_ratio)
    images, indices = torch.arange(20) % 2, box_levels(boxes, config)
    assert len(indices.unique()) == 3
    with torch.no_grad():
        cells = pyramid_align(levels, boxes, images, config, size=3)
    trained = torch.empty_like(cells)
    for level, features in enumerate(levels):
        rows, grid = indices == level, {"size": 3, "stride": 4 * 2**level}
        trained[rows] = roi_align(features, boxes[rows], images[rows], sampling_ratio=sampling_ratio, **grid)
    for number, (box, image, level) in enumerate(zip(boxes, images, indices, strict=True)):
        for channel in range(3):
            expected = naive.roi_align(
                levels[level][image, channel].numpy(),
                tuple(box.tolist()),
                size=3,
                stride=4 * 2 ** int(level),
                sampling_ratio=sampling_ratio,
            )
            for found in (cells, trained):
                assert np.allclose(found[number, channel], expected, atol=1e-12)


def test_aligned_features_are_those_of_training():
    generator = torch.Generator().manual_seed(0)
    levels = [torch.randn(2, 4, 32 // 2**k, 64 // 2**k, generator=generator) for k in range(3)]
    low = 100 * torch.rand(9, 2, generator=generator)
    boxes = torch.cat([low, low + 100 * torch.rand(9, 2, generator=generator)], dim=1)
    trained = pyramid_align(levels, boxes, torch.arange(9) % 2, SMALL, size=7)
    with torch.no_grad():
        found = pyramid_align(levels, boxes, torch.arange(9) % 2, SMALL, size=7)
        assert torch.allclose(found, trained, atol=1e-5)
        assert pyramid_align(levels, boxes[:0], torch.arange(0), SMALL, size=7).shape == (0, 4, 7, 7)
