"""Making more of training frames: objects in other colours, and mirror images."""

import numpy as np

from openvima.detector.frames import Frame

RECOLOURED = 0.5  # share of the objects; so that textures that training lacks are found, too
MIRRORED = 0.5  # share of the frames


def augmented(frame: Frame, rng: np.random.Generator) -> Frame:
    """Return a frame with some of its objects in other colours, mirrored or not."""
    rgb = frame.rgb.copy()
    for mask in frame.masks:
        if rng.random() < RECOLOURED:
            rgb[:, mask] = recoloured(rgb[:, mask], rng)
    changed = Frame(rgb, frame.boxes, frame.masks)
    return mirrored(changed) if rng.random() < MIRRORED else changed


def recoloured(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Mix the channels of pixels (3, K), uint8, by a matrix and a shift drawn at random.

    Light and dark keep or change places, and two colours that differ go on differing for the most part.
    """
    mixing = rng.uniform(-1, 1, (3, 3))
    mixing /= np.abs(mixing).sum(axis=1, keepdims=True)
    centred = pixels.astype(np.float64) / 255 - 0.5
    mixed = 2 * rng.uniform(0.3, 1) * mixing @ centred + rng.uniform(0.15, 0.85, (3, 1))
    return (mixed * 255).round().clip(0, 255).astype(np.uint8)


def mirrored(frame: Frame) -> Frame:
    """Exchange left and right."""
    width = frame.rgb.shape[2]
    boxes = frame.boxes.copy()
    boxes[:, [0, 2]] = width - boxes[:, [2, 0]]
    return Frame(frame.rgb[:, :, ::-1].copy(), boxes, frame.masks[:, :, ::-1].copy())
