"""Augmentation of training frames: copies on top of objects, random recolouring, horizontal flips."""

import numpy as np

from openvima.detector.frames import Frame, frame_of_masks

RECOLOUR_PROB = 0.5  # of each object, so that unseen textures are found, too
FLIP_PROB = 0.5  # of each frame
LEAST_VISIBLE = 0.1  # fraction of an object that a pasted one leaves


def augment_frame(frame: Frame, rng: np.random.Generator, *, paste_prob: float = 0.0) -> Frame:
    """Paste an object onto another one, recolour some, and flip the frame at random.

    Args:
        frame: The frame.
        rng: Source of all draws.
        paste_prob: Probability of pasting.
    """
    if paste_prob and len(frame.masks) and rng.random() < paste_prob:
        frame = paste_object(frame, rng)
    rgb = frame.rgb.copy()
    for mask in frame.masks:
        if rng.random() < RECOLOUR_PROB:
            rgb[:, mask] = mix_channels(rgb[:, mask], rng)
    changed = Frame(rgb, frame.boxes, frame.masks)
    return flip_horizontally(changed) if rng.random() < FLIP_PROB else changed


def paste_object(frame: Frame, rng: np.random.Generator) -> Frame:
    """Paste a copy of an object onto an object, perhaps onto itself: stacks and full containers are rare.

    Args:
        frame: The frame, with at least one object.
        rng: Selects both objects, the position and whether the copy is mirrored.

    Returns:
        The frame with one more object. It is unchanged if the copy would not fit into the image, or hide an
        object.

    Source: copy-paste augmentation (Ghiasi et al. 2021).
    """
    source, target = rng.integers(len(frame.masks), size=2).tolist()
    left, upper, right, lower = frame.boxes[source].astype(int).tolist()
    x0, y0, x1, y1 = frame.boxes[target].tolist()
    centre = (x0 + x1) / 2, (y0 + y1) / 2
    offset = rng.uniform(-0.3, 0.3, 2) * (x1 - x0, y1 - y0)
    column, row = (
        (np.array(centre) + offset - (right - left, lower - upper) * np.array(0.5)).round().astype(int)
    )
    height, width = frame.rgb.shape[1:]
    if not (0 <= column <= width - (right - left) and 0 <= row <= height - (lower - upper)):
        return frame
    step = -1 if rng.random() < 0.5 else 1
    shape = frame.masks[source, upper:lower, left:right][:, ::step]
    pixels = frame.rgb[:, upper:lower, left:right][:, :, ::step]
    rgb, pasted = frame.rgb.copy(), np.zeros((1, height, width), bool)
    window = slice(row, row + lower - upper), slice(column, column + right - left)
    pasted[0][window] = shape
    rgb[(slice(None), *window)][:, shape] = pixels[:, shape]
    left_over = frame.masks & ~pasted
    if (left_over.sum(axis=(1, 2)) < LEAST_VISIBLE * frame.masks.sum(axis=(1, 2))).any():
        return frame
    return frame_of_masks(rgb, np.concatenate([left_over, pasted]))


def mix_channels(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Mix the channels of pixels (3, K), uint8, by a random matrix and a random shift.

    Brightness is kept or inverted. Distinct colours mostly stay distinct.
    """
    mixing = rng.uniform(-1, 1, (3, 3))
    mixing /= np.abs(mixing).sum(axis=1, keepdims=True)
    centred = pixels.astype(np.float64) / 255 - 0.5
    mixed = 2 * rng.uniform(0.3, 1) * mixing @ centred + rng.uniform(0.15, 0.85, (3, 1))
    return (mixed * 255).round().clip(0, 255).astype(np.uint8)


def flip_horizontally(frame: Frame) -> Frame:
    """Mirror a frame with its boxes and masks."""
    width = frame.rgb.shape[2]
    boxes = frame.boxes.copy()
    boxes[:, [0, 2]] = width - boxes[:, [2, 0]]
    return Frame(frame.rgb[:, :, ::-1].copy(), boxes, frame.masks[:, :, ::-1].copy())
