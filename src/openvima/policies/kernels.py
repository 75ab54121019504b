"""Numba kernels of the processor: objects of all steps or prompts of a batch, padded in one pass.

Only loops over arrays that the caller prepared; `processor.py` owns the documentation. Views: front 0, top 1.
"""

import numpy as np

from openvima.compilation import njit

_WIDTH, _HEIGHT = 1, 2  # halves, in the last row of a camera's matrix


@njit
def table_point(camera, column, row, point):
    """Fill `point` (2,) with the point on the table under a pixel; every rounding is that of `unproject`."""
    right, up, away, focal_px = camera[0], camera[1], camera[2], camera[3, 0]
    tangent_right = (column - camera[3, _WIDTH]) / focal_px
    tangent_up = (2 * camera[3, _HEIGHT] - 1 - row - camera[3, _HEIGHT]) / focal_px
    a0, b0 = right[0] - tangent_right * away[0], right[1] - tangent_right * away[1]
    a1, b1 = up[0] - tangent_up * away[0], up[1] - tangent_up * away[1]
    c0 = -((right[2] - tangent_right * away[2]) * 0.0 + (right[3] - tangent_right * away[3]))
    c1 = -((up[2] - tangent_up * away[2]) * 0.0 + (up[3] - tangent_up * away[3]))
    determinant = a0 * b1 - a1 * b0
    point[0] = (c0 * b1 - c1 * b0) / determinant
    point[1] = (a0 * c1 - a1 * c0) / determinant


@njit
def pad_false_positives(
    cameras, have_points, place, offsets, crop_index, boxes, new_index, new_boxes, points
):
    """Move the false detections of each step to its place in padded arrays, which are zero.

    Per step (S,): `place`, `offsets` of its images, `crop_index` (S, 2), `boxes` (S, 2, 4). To fill, for P
    places: `new_index` (P, 2), `new_boxes` (P, 2, 4), and `points` (P, 2, 2) if there are any.
    """
    for step in range(len(place)):
        p = place[step]
        for view in range(2):
            index = crop_index[step, view]
            new_index[p, view] = index + offsets[step] if index > 0 else 0
            for k in range(4):
                new_boxes[p, view, k] = boxes[step, view, k]
            if have_points:
                table_point(cameras[view], boxes[step, view, 0], boxes[step, view, 1], points[p, view])


@njit
def pad_history(
    cameras,
    place,
    counts,
    slots,
    offsets,
    crop_index,
    boxes,
    grasps,
    new_index,
    new_boxes,
    masks,
    points,
    picks,
):
    """Move the objects of each step to its place in padded arrays, which are zero.

    Per step (S,): `place`, number of objects `counts`, of slots `slots` (a slot without an object is at the
    corner of the front view), `offsets` of its images. Per object: `crop_index` (M, 2), `boxes` (M, 2, 4),
    `grasps` (M, 2, 2). To fill, P places of N slots: `new_index` and `masks` (P, 2, N), `new_boxes`
    (P, 2, N, 4), `points` and `picks` (P, N, 2), under centres of boxes and under grasps.
    """
    row = 0
    for step in range(len(place)):
        p = place[step]
        for slot in range(counts[step]):
            for view in range(2):
                index = crop_index[row, view]
                if index > 0:
                    new_index[p, view, slot] = index + offsets[step]
                    masks[p, view, slot] = True
                for k in range(4):
                    new_boxes[p, view, slot, k] = boxes[row, view, k]
            view = 1 if crop_index[row, 1] > 0 else 0
            table_point(cameras[view], boxes[row, view, 0], boxes[row, view, 1], points[p, slot])
            table_point(cameras[view], grasps[row, view, 0], grasps[row, view, 1], picks[p, slot])
            row += 1
        for slot in range(counts[step], slots[step]):
            table_point(cameras[0], 0, 0, points[p, slot])
            table_point(cameras[0], 0, 0, picks[p, slot])


@njit
def pad_prompts(lengths, first, num_objects, tokens, is_valid, words, objects, mask):
    """Pad the tokens of prompts, and number their objects across the batch.

    Per prompt (B,): number of tokens `lengths`, `first` of its objects, of which there are `num_objects` in
    all. Per token: `tokens` (W, 3), word, row of its object or -1, and part of that; `is_valid` (W,). Fills
    the beginning of each row of `words`, `objects` and `mask`, (B, L).
    """
    row = 0
    for b in range(len(lengths)):
        for position in range(lengths[b]):
            words[b, position] = tokens[row, 0]
            if tokens[row, 1] >= 0:
                objects[b, position] = tokens[row, 1] + tokens[row, 2] * num_objects + first[b]
            mask[b, position] = is_valid[row]
            row += 1


@njit
def stack_prompt_objects(cameras, offsets, rows, crop_index, boxes, new_index, new_boxes, masks, points):
    """Put the views of the objects of prompts first.

    Given `offsets` and `rows` (S,), those of `crop_index` (R, 2) and `boxes` (R, 2, 4) that are asked for,
    fills `new_index` and `masks` (2, S), `new_boxes` (2, S, 4) and `points` (S, 2).
    """
    for k in range(len(rows)):
        row = rows[k]
        for view in range(2):
            index = crop_index[row, view]
            new_index[view, k] = index + offsets[k] if index > 0 else 0
            masks[view, k] = index > 0
            for n in range(4):
                new_boxes[view, k, n] = boxes[row, view, n]
        view = 1 if crop_index[row, 1] > 0 else 0
        table_point(cameras[view], boxes[row, view, 0], boxes[row, view, 1], points[k])


@njit
def find_slots(counts, ids, wanted, slots):
    """Fill `slots` (S,) with the slot of the id that is `wanted` in each step, -1 where no object has it."""
    row = 0
    for step in range(len(counts)):
        slots[step] = -1
        for slot in range(counts[step]):
            if ids[row] == wanted[step]:
                slots[step] = slot
            row += 1


def int64(array: np.ndarray) -> np.ndarray:
    """Return an array as contiguous int64, the only integers that the kernels are compiled for."""
    return np.ascontiguousarray(array, np.int64)
