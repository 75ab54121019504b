"""Proposals: the best boxes of all levels, without duplicates within one."""

from dataclasses import replace

import pytest

import slow_detection as slow

torch = pytest.importorskip("torch")
from openvima.detector.boxes import clip, decode_boxes  # noqa: E402
from openvima.detector.proposals import WEIGHTS, ProposalNetwork, ScoredAnchors  # noqa: E402

HEIGHT, WIDTH = 64, 96


def scored(tiny, seed: int) -> ScoredAnchors:
    """Anchors of two levels with scores of which many are equal, of two images."""
    torch.manual_seed(seed)
    levels = [torch.randn(2, 16, HEIGHT // stride, WIDTH // stride) for stride in (4, 8)]
    with torch.no_grad():
        said = ProposalNetwork(tiny)(levels)
        scores = [(part * 40).round() for part in said.scores]
        return ScoredAnchors(said.anchors, scores, [torch.randn_like(part) for part in said.deltas])


def propose(config, given: ScoredAnchors) -> list[torch.Tensor]:
    return ProposalNetwork(config).propose(given, height=HEIGHT, width=WIDTH)


@pytest.mark.parametrize("seed", range(3))
def test_proposals_agree_with_going_through_the_best_boxes_of_each_level(tiny, seed):
    config, given = replace(tiny, candidates=40, proposals=50), scored(tiny, seed)
    for image, proposed in enumerate(propose(config, given)):
        boxes, scores, levels = [], [], []
        for level, anchors in enumerate(given.anchors):
            best, rows = given.scores[level][image].topk(40)
            decoded = decode_boxes(given.deltas[level][image, rows], anchors[rows], WEIGHTS)
            boxes += clip(decoded, height=HEIGHT, width=WIDTH).tolist()
            scores += best.tolist()
            levels += [level] * 40
        solid = [n for n, box in enumerate(boxes) if box[2] > box[0] and box[3] > box[1]]
        boxes, scores, levels = ([values[n] for n in solid] for values in (boxes, scores, levels))
        kept = slow.suppress(boxes, scores, config.proposal_overlap, levels)[:50]
        assert proposed.tolist() == [boxes[number] for number in kept]


def test_boxes_of_different_levels_do_not_compete(tiny):
    anchors = torch.tensor([[10.0, 10, 30, 30], [50, 10, 70, 30]])
    scores = [torch.tensor([[2.0, 1.0]]), torch.tensor([[4.0, 3.0]])]
    given = ScoredAnchors([anchors, anchors], scores, [torch.zeros(1, 2, 4)] * 2)
    (proposed,) = propose(tiny, given)
    assert torch.equal(proposed, torch.cat([anchors, anchors]))
