"""Assignment of objects to boxes, and sampling of boxes."""

import pytest

torch = pytest.importorskip("torch")
from openvima.detector.boxes import match, subsample  # noqa: E402

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
