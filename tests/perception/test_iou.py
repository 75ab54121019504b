"""Which boxes are which objects: cases computed by hand."""

import numpy as np
import pytest

from openvima.perception.boxes import match_ids_to_slots, object_iou
from openvima.perception.objects import ObjectViews, see_nothing


def objects(*boxes: tuple, view: int = 1, first_id: int = 5) -> ObjectViews:
    """Objects with these boxes (first column, first row, last column, last row) in one view."""
    found = see_nothing(len(boxes))
    found.ids[:] = np.arange(first_id, first_id + len(boxes))
    for slot, (left, upper, right, lower) in enumerate(boxes):
        found.masks[view, slot] = True
        found.boxes[view, slot] = (left + right) // 2, (upper + lower) // 2, lower - upper, right - left
    return found


@pytest.mark.parametrize(
    ("box", "other", "expected"),
    [
        ((0, 0, 9, 9), (0, 0, 9, 9), 1.0),
        ((0, 0, 9, 9), (10, 0, 19, 9), 0.0),  # neighbours
        ((0, 0, 9, 9), (5, 0, 14, 9), 50 / 150),
        ((3, 4, 5, 9), (0, 0, 9, 9), 18 / 100),
        ((7, 2, 7, 2), (7, 2, 7, 2), 1.0),  # a single pixel
        ((4, 6, 11, 12), (5, 6, 12, 12), 7 / 9),
    ],
)
def test_overlap_is_intersection_over_union_of_pixels(box, other, expected) -> None:
    for view in (0, 1):
        shares = object_iou(objects(box, view=view), objects(other, view=view))
        np.testing.assert_allclose(shares, [[expected]])


def test_boxes_of_different_views_do_not_overlap_and_the_better_view_counts() -> None:
    box = (10, 10, 29, 29)
    assert object_iou(objects(box, view=0), objects(box, view=1)).tolist() == [[0.0]]
    both, other = objects(box, view=0), objects(box, view=0)
    for found, left in ((both, 100), (other, 110)):
        found.masks[1], found.boxes[1] = True, (left, 50, 19, 19)
    np.testing.assert_allclose(object_iou(both, other), [[1.0]])


def test_each_object_takes_the_slot_that_overlaps_it_most_and_none_twice() -> None:
    true = objects((0, 0, 9, 9), (2, 0, 11, 9), (50, 50, 59, 59))
    found = objects((50, 54, 59, 63), (0, 0, 10, 9), (100, 100, 109, 109), (3, 0, 12, 9), first_id=0)
    assert match_ids_to_slots(found, true) == {5: 1, 6: 3}  # the third overlaps by 60 of 140 only
    assert match_ids_to_slots(found.select(np.array([1])), true) == {5: 0}  # 6 overlaps it, too, but less


def test_where_nothing_is_found_or_there_nothing_is_named() -> None:
    box = objects((0, 0, 9, 9))
    assert match_ids_to_slots(see_nothing(), box) == match_ids_to_slots(box, see_nothing()) == {}
    assert match_ids_to_slots(see_nothing(1), box) == {}
