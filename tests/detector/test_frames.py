"""Annotated frames of demonstrations, and their augmentation."""

import numpy as np

from openvima.data import Dataset
from openvima.detector.frames import (
    FrameSampler,
    augment_frame,
    flip_horizontally,
    frame_of,
    held_out_frames,
    mix_channels,
    paste_object,
)
from openvima.perception.objects import observe, observe_prompt_image


def test_boxes_reach_from_the_first_pixel_to_the_end_of_the_last():
    segm = np.full((8, 12), 255, np.uint8)
    segm[2:5, 3:9] = 7
    segm[0, 0] = 6  # a single pixel is no object
    frame = frame_of(np.zeros((3, 8, 12), np.uint8), segm, range(5, 255))
    assert frame.boxes.tolist() == [[3, 2, 9, 5]]
    assert np.array_equal(frame.masks, [segm == 7])


def test_frames_show_the_objects_that_policies_see(data):
    dataset = Dataset(data)
    for episode in range(len(dataset)):
        front, top = FrameSampler(dataset, prompt_prob=0.0).sample(episode, np.random.default_rng(0))
        demo = dataset[episode]
        moments = [t for t, rgb in enumerate(demo.rgb["front"]) if np.array_equal(rgb, front.rgb)]
        observation = {
            kind: {view: getattr(demo, kind)[view][moments[0]] for view in ("front", "top")}
            for kind in ("rgb", "segm")
        }
        ee = ("suction", "spatula").index(demo.end_effector)
        seen = observe({**observation, "ee": ee})
        assert np.array_equal(top.rgb, observation["rgb"]["top"])
        for view, frame in enumerate((front, top)):
            sizes = frame.boxes[:, [3, 2]] - frame.boxes[:, [1, 0]] - 1
            assert sorted(sizes.tolist()) == sorted(seen.boxes[view, seen.masks[view], 2:].tolist())


def test_frames_of_prompts_show_the_objects_that_policies_see(data):
    dataset = Dataset(data)
    source = FrameSampler(dataset, prompt_prob=1.0)
    for episode in range(len(dataset)):
        front, _ = source.sample(episode, np.random.default_rng(1))
        images = dataset[episode].prompt.images.values()
        (image,) = [image for image in images if np.array_equal(image.rgb["front"], front.rgb)][:1]
        assert len(front.boxes) == observe_prompt_image(image).masks[0].sum()


def test_rerendered_frames_have_other_objects_in_the_same_places(data):
    dataset, drawn = Dataset(data), []
    for prob in (0.0, 1.0):
        source = FrameSampler(dataset, prompt_prob=0.0, rerendered_prob=prob)
        drawn.append([source.sample(row, np.random.default_rng(0)) for row in range(len(dataset))])
    shown = [np.stack([f.rgb for frames in side for f in frames]) for side in drawn]
    assert not np.array_equal(*shown)
    assert all(len(f.boxes) for frames in drawn[1] for f in frames)
    prompts = FrameSampler(dataset, prompt_prob=1.0, rerendered_prob=1.0)
    (front, top), (again, _) = (prompts.sample(1, np.random.default_rng(0)) for _ in range(2))
    assert np.array_equal(front.rgb, again.rgb)
    assert len(top.boxes) and (top.rgb[:, 0, 0] == 255).all()  # on white, as images of objects are


def test_held_out_frames_are_the_same_for_the_same_seed(data):
    source = FrameSampler(Dataset(data))
    first, again = (list(held_out_frames(source, 10, seed=3)) for _ in range(2))
    assert len(first) == 10
    assert all(np.array_equal(a.rgb, b.rgb) for a, b in zip(first, again, strict=True))
    assert len(list(held_out_frames(source, 30, seed=3))) == 30  # more than there are episodes


def test_mirroring_twice_changes_nothing_and_once_moves_boxes_with_masks(rectangles):
    frame = rectangles()
    once, twice = flip_horizontally(frame), flip_horizontally(flip_horizontally(frame))
    assert np.array_equal(twice.rgb, frame.rgb) and np.array_equal(twice.boxes, frame.boxes)
    for box, mask in zip(once.boxes.astype(int), once.masks, strict=True):
        assert mask[box[1] : box[3], box[0] : box[2]].all()
        assert mask.sum() == (box[2] - box[0]) * (box[3] - box[1])


def test_a_pasted_object_covers_others_and_has_their_pixels(rectangles):
    frame, counts = rectangles(), set()
    for seed in range(30):
        pasted = paste_object(frame, np.random.default_rng(seed))
        counts.add(len(pasted.boxes))
        if len(pasted.boxes) == len(frame.boxes):
            assert np.array_equal(pasted.rgb, frame.rgb)
            continue
        *others, own = pasted.masks
        assert not (np.array(others) & own).any()
        assert np.array_equal(np.any(others, axis=0) | own, frame.masks.any(axis=0) | own)
        colours = {tuple(colour) for colour in pasted.rgb[:, own].T.tolist()}
        assert any(colours <= {tuple(c) for c in frame.rgb[:, m].T.tolist()} for m in frame.masks)
        assert np.array_equal(pasted.rgb[:, ~own], frame.rgb[:, ~own])
        left, upper, right, lower = pasted.boxes[-1].astype(int)
        assert own[upper:lower, left:right].sum() == own.sum()
        assert own[:, left].any() and own[upper].any()
    assert counts == {len(frame.boxes), len(frame.boxes) + 1}
    assert len(augment_frame(frame, np.random.default_rng(1), paste_prob=0.0).boxes) == len(frame.boxes)


def test_only_objects_change_colour(rectangles):
    frame = rectangles()
    rng = np.random.default_rng(0)
    changed = [augment_frame(frame, rng) for _ in range(20)]
    assert all((one.rgb[:, ~one.masks.any(axis=0)] == 51).all() for one in changed)
    assert any(not np.array_equal(np.unique(one.rgb), np.unique(frame.rgb)) for one in changed)
    assert np.array_equal(frame.rgb, rectangles().rgb)  # left as it was


def test_one_colour_becomes_one_colour_and_two_stay_two():
    pixels = np.array([[200, 200, 10], [40, 40, 90], [0, 0, 255]], np.uint8)
    for seed in range(20):
        mixed = mix_channels(pixels, np.random.default_rng(seed))
        assert np.array_equal(mixed[:, 0], mixed[:, 1])
        assert not np.array_equal(mixed[:, 0], mixed[:, 2])
