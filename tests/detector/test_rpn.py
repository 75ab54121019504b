"""Proposals: the best boxes of all levels, with NMS per level."""

from dataclasses import replace

import pytest
import torch

import naive
from openvima.detector.boxes import decode_boxes
from openvima.detector.layers import PROPOSAL_WEIGHTS, AnchorPredictions, RegionProposalNetwork

HEIGHT, WIDTH = 64, 96


def scored(tiny, seed: int) -> AnchorPredictions:
    """Predictions on two levels of two images, with many equal scores."""
    torch.manual_seed(seed)
    levels = [torch.randn(2, 16, HEIGHT // stride, WIDTH // stride) for stride in (4, 8)]
    with torch.no_grad():
        predictions = RegionProposalNetwork(tiny)(levels)
        scores = [(part * 40).round() for part in predictions.objectness]
        return AnchorPredictions(
            predictions.anchors, scores, [torch.randn_like(part) for part in predictions.deltas]
        )


def propose(config, given: AnchorPredictions) -> list[torch.Tensor]:
    return RegionProposalNetwork(config).propose(given, height=HEIGHT, width=WIDTH)


@pytest.mark.parametrize("seed", range(3))
def test_proposals_agree_with_sequential_nms_per_level(tiny, seed):
    config, given = replace(tiny, rpn_pre_nms_top_n=40, rpn_post_nms_top_n=50), scored(tiny, seed)
    for image, proposed in enumerate(propose(config, given)):
        boxes, scores, levels = [], [], []
        for level, anchors in enumerate(given.anchors):
            best, rows = given.objectness[level][image].topk(40)
            deltas = given.deltas[level][image, rows]
            boxes += decode_boxes(
                deltas, anchors[rows], PROPOSAL_WEIGHTS, height=HEIGHT, width=WIDTH
            ).tolist()
            scores += best.tolist()
            levels += [level] * 40
        solid = [n for n, box in enumerate(boxes) if box[2] > box[0] and box[3] > box[1]]
        boxes, scores, levels = ([values[n] for n in solid] for values in (boxes, scores, levels))
        kept = naive.nms(boxes, scores, config.rpn_nms_iou, levels)[:50]
        assert proposed.tolist() == [boxes[number] for number in kept]


def test_boxes_of_different_levels_do_not_suppress_each_other(tiny):
    anchors = torch.tensor([[10.0, 10, 30, 30], [50, 10, 70, 30]])
    scores = [torch.tensor([[2.0, 1.0]]), torch.tensor([[4.0, 3.0]])]
    given = AnchorPredictions([anchors, anchors], scores, [torch.zeros(1, 2, 4)] * 2)
    (proposed,) = propose(tiny, given)
    assert torch.equal(proposed, torch.cat([anchors, anchors]))
