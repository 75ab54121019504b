"""Which boxes are which objects: cases computed by hand."""

import numpy as np
import pytest

from openvima.env import TabletopEnv
from openvima.perception.boxes import BoxJitter, match_ids_to_slots, object_iou
from openvima.perception.objects import ObjectViews, crop_box, make_hidden_objects, observe
from openvima.perception.preprocessing import FOUND, ImageStack, extract_observation, preprocess_prompt
from openvima.render.camera import VIEWS


def objects(*boxes: tuple, view: int = 1, first_id: int = 5) -> ObjectViews:
    """Objects with these boxes (first column, first row, last column, last row) in one view."""
    found = make_hidden_objects(len(boxes))
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
    box = objects((0, 0, 9, 9))
    assert (
        match_ids_to_slots(make_hidden_objects(), box) == match_ids_to_slots(box, make_hidden_objects()) == {}
    )
    assert match_ids_to_slots(make_hidden_objects(1), box) == {}


def edges(objects: ObjectViews) -> np.ndarray:
    """First and last column, first and last row of visible boxes, from centre and size."""
    x, y, tall, wide = np.moveaxis(objects.boxes[objects.masks], -1, 0)
    left, upper = (2 * x + wide % 2 - wide) // 2, (2 * y + tall % 2 - tall) // 2
    return np.stack([left, left + wide, upper, upper + tall], axis=-1)


@pytest.fixture(scope="module")
def begun():
    env = TabletopEnv("rearrange", level="L1", domain="eval")
    return env, env.reset(seed=3)[0]


def by_id(objects: ObjectViews) -> ObjectViews:
    return objects.select(np.argsort(objects.ids))


def test_no_jitter_gives_the_boxes_and_crops_of_the_segmentation(begun):
    _, observation = begun
    true, found = observe(observation), BoxJitter(0, np.random.default_rng(0)).observation(observation)[FOUND]
    for name in ("ids", "crops", "boxes", "masks", "grasps"):
        assert np.array_equal(getattr(true, name), getattr(found, name)), name


def test_borders_move_by_up_to_so_many_pixels_and_crops_with_them(begun):
    _, observation = begun
    jitter, true, shifts = BoxJitter(3, np.random.default_rng(0)), by_id(observe(observation)), []
    for _ in range(20):
        found = by_id(jitter.observation(observation)[FOUND])
        shifts.append(edges(found) - edges(true))
        assert np.array_equal(found.ids, true.ids) and np.array_equal(found.masks, true.masks)
        visible = np.argwhere(found.masks)
        for (v, k), extent in zip(visible, edges(found), strict=True):
            crop, box = crop_box(observation["rgb"][VIEWS[v]], extent.tolist())
            assert np.array_equal(crop, found.crops[v, k]) and np.array_equal(box, found.boxes[v, k])
            column, row = found.grasps[v, k]
            assert extent[0] <= column <= extent[1] and extent[2] <= row <= extent[3]
    shifts = np.concatenate(shifts)
    assert set(np.unique(shifts)) == set(range(-3, 4))
    assert all(len(np.unique(border)) == 7 for border in shifts.T)  # each border by its own draw
    assert np.abs(shifts.mean(axis=0)).max() < 0.5


def test_boxes_stay_within_the_image(begun):
    _, observation = begun
    found = BoxJitter(32, np.random.default_rng(1)).observation(observation)[FOUND]
    left, right, upper, lower = edges(found).T
    assert (left >= 0).all() and (right < 256).all() and (upper >= 0).all() and (lower < 128).all()
    assert (left <= right).all() and (upper <= lower).all()


def test_networks_on_objects_get_the_moved_boxes_and_those_on_frames_see_no_difference(begun):
    env, observation = begun
    jitter = BoxJitter(3, np.random.default_rng(0))
    moved = jitter.observation(observation)
    assert extract_observation(moved, "objects") is moved[FOUND]
    whole = [extract_observation(seen, "frames") for seen in (observation, moved)]
    assert np.array_equal(whole[0].crops, whole[1].crops)
    names = list(env.prompt.images)
    prompt = type(env.prompt)(env.prompt.text, {n: jitter.prompt_image(env.prompt.images[n]) for n in names})
    plain, noisy = (
        preprocess_prompt(each, "objects", None, ImageStack("objects")) for each in (env.prompt, prompt)
    )
    assert np.array_equal(plain.objects.ids, noisy.objects.ids)
    assert (plain.objects.boxes != noisy.objects.boxes).any()
    assert prompt.images[names[0]].rgb is env.prompt.images[names[0]].rgb
