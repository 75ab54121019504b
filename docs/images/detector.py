"""Draw detector.png: the stages of the detector on one frame, with ground-truth boxes."""

from pathlib import Path
from typing import Any  # the type of matplotlib's axes is not public

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import openvima
from openvima.detector.boxes import match, pyramid_anchors
from openvima.detector.config import FIRST_STRIDE, SMALL
from openvima.detector.frames import Frame, frame_of
from openvima.detector.layers import BACKGROUND_IOU
from openvima.detector.roi_align import box_levels, crop_masks, paste_masks
from openvima.render import channels_last
from openvima.render.camera import FRONT
from openvima.scene import FIRST_OBJECT_ID

TASK, SEED = "visual_manipulation", 6  # a scene with objects of two sizes; any other will do
COLOURS = ("#0072b2", "#d98200", "#9b2393")  # of the pyramid levels, finest first
INK = "#1f2933"
STYLE = {"font.family": "DejaVu Sans", "font.size": 9, "text.color": INK, "axes.titlelocation": "left"}


def frame() -> Frame:
    """The frame of the front camera."""
    env = openvima.make(TASK, level="train")
    observation, _ = env.reset(seed=SEED)
    ids = range(FIRST_OBJECT_ID["suction"], 255)
    return frame_of(observation["rgb"]["front"], observation["segm"]["front"], ids)


def draw_anchors(axes: Any, annotated: Frame) -> None:
    """Draw the foreground anchors, coloured by level."""
    sizes = SMALL
    strides = [FIRST_STRIDE * 2**k for k in range(len(sizes.anchor_sizes))]
    shapes = tuple((FRONT.height // stride, FRONT.width // stride) for stride in strides)
    levels = pyramid_anchors(sizes.anchor_sizes, shapes)
    _, labels = match(
        torch.cat(levels),
        torch.from_numpy(annotated.boxes),
        low=BACKGROUND_IOU,
        high=sizes.rpn_foreground_iou,
        allow_low_quality=True,
    )
    parts = labels.split([len(level) for level in levels])
    for colour, level, own in zip(COLOURS, levels, parts, strict=True):
        for edges in level[own == 1].tolist():
            draw_box(axes, edges, colour)
    total = sum(len(level) for level in levels)
    axes.set_title(f"1  of {total:,} anchors, these are foreground; one colour per level", fontsize=9)


def draw_grids(axes: Any, annotated: Frame) -> None:
    """Draw the RoIAlign grids of the box head, coloured by level."""
    sizes = SMALL
    boxes = torch.from_numpy(annotated.boxes)
    levels = box_levels(boxes, sizes).tolist()
    for (left, upper, right, lower), level in zip(annotated.boxes.tolist(), levels, strict=True):
        columns = np.linspace(left, right, sizes.box_pool_size + 1)
        rows = np.linspace(upper, lower, sizes.box_pool_size + 1)
        axes.vlines(columns, upper, lower, COLOURS[level], linewidth=0.7)
        axes.hlines(rows, left, right, COLOURS[level], linewidth=0.7)
    axes.set_title(f"2  RoIAlign: {sizes.box_pool_size} × {sizes.box_pool_size} cells per box", fontsize=9)


def draw_masks(axes: Any, annotated: Frame) -> None:
    """Draw masks resampled to the grid of the mask head and pasted back."""
    sizes = SMALL
    boxes = torch.from_numpy(annotated.boxes)
    grids = crop_masks(torch.from_numpy(annotated.masks), boxes, size=2 * sizes.mask_pool_size)
    pasted = paste_masks(grids.float(), boxes, height=FRONT.height, width=FRONT.width).numpy()
    for number, (mask, edges) in enumerate(zip(pasted, annotated.boxes.tolist(), strict=True)):
        colour = np.array([int(COLOURS[number % 3][k : k + 2], 16) for k in (1, 3, 5)]) / 255
        overlay = np.zeros((*mask.shape, 4))
        overlay[mask] = [*colour, 0.6]
        axes.imshow(overlay, extent=(0, FRONT.width, FRONT.height, 0))
        draw_box(axes, edges, COLOURS[number % 3])
    shared = (pasted & annotated.masks).sum() / (pasted | annotated.masks).sum()
    side = 2 * sizes.mask_pool_size
    axes.set_title(f"3  masks on {side} × {side} cells: IoU {shared:.2f}", fontsize=9)


def draw_box(axes: Any, edges: list[float], colour: str) -> None:
    """The outline of a box."""
    left, upper, right, lower = edges
    axes.add_patch(
        Rectangle((left, upper), right - left, lower - upper, fill=False, edgecolor=colour, linewidth=0.9)
    )


def draw() -> Figure:
    """Draw the three stages side by side."""
    annotated = frame()
    with rc_context(STYLE):
        figure = Figure(figsize=(13.5, 2.7), layout="constrained")
        for axes, step in zip(figure.subplots(1, 3), (draw_anchors, draw_grids, draw_masks), strict=True):
            axes.imshow(channels_last(annotated.rgb), extent=(0, FRONT.width, FRONT.height, 0))
            step(axes, annotated)
            axes.set_axis_off()
    return figure


if __name__ == "__main__":
    with rc_context(STYLE):
        draw().savefig(Path(__file__).with_suffix(".png"), dpi=110, metadata={"Software": None})
