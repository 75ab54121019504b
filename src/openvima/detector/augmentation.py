"""Augmentation of training frames: random recolouring of objects and horizontal flips."""

import numpy as np

from openvima.detector.frames import Frame

RECOLOUR_PROB = 0.5  # of each object, so that unseen textures are found, too
FLIP_PROB = 0.5  # of each frame


def augment_frame(frame: Frame, rng: np.random.Generator) -> Frame:
    """Recolour some objects of a frame and flip it at random."""
    rgb = frame.rgb.copy()
    for mask in frame.masks:
        if rng.random() < RECOLOUR_PROB:
            rgb[:, mask] = mix_channels(rgb[:, mask], rng)
    changed = Frame(rgb, frame.boxes, frame.masks)
    return flip_horizontally(changed) if rng.random() < FLIP_PROB else changed


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
