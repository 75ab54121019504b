"""Draw openvima_small_network.png: the inputs of openvima-small, and its place candidates.

Words, crops, boxes and grid candidates are the network's inputs; actions are the oracle's.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any  # the type of matplotlib's axes is not public

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.perception.objects import ObjectViews, observe, observe_prompt_image
from openvima.policies import preset
from openvima.policies.batch import WORD
from openvima.policies.pointer.candidates import GridCandidates
from openvima.policies.processor import Processor
from openvima.policies.tokenizer import END_ID, benchmark_vocabulary
from openvima.render.camera import TOP, project
from openvima.scene import PromptImage
from policy import (
    FAINT,
    INK,
    LAYERS,
    OUTPUT,
    PAPER,
    STYLE,
    VIEWS,
    draw_arrow,
    draw_box,
    draw_frame,
    draw_picture,
    draw_text,
    draw_title,
    picture,
)

TASK, SEED = "rearrange_then_restore", 10  # one object is moved to a goal position, and back
WIDTH, HEIGHT = 11.0, 8.42  # inches, as all coordinates below, from the upper left corner
LEFT, SIZE = 0.95, 0.36  # left margin; side of a crop
PROMPT, AT_FIRST = "#d98200", "#8250c4"  # candidates from the prompt, and from the first step


def demonstration() -> Demonstration:
    """Return an oracle rollout."""
    return rollout_oracle(TabletopEnv(TASK, level="train"), SEED)


def prompt_scene(demo: Demonstration) -> PromptImage:
    """Return the scene image of the prompt."""
    return next(p for p in demo.prompt.sequence() if isinstance(p, PromptImage) and p.kind == "scene")


def draw_word(axes: Any, text: str, x: float, y: float) -> float:
    """Draw a word token centred at y; return its width."""
    width = max(0.24, 0.13 + 0.078 * len(text))
    draw_box(axes, x, y - 0.18, (width, 0.36), facecolor=PAPER)
    draw_text(axes, x + width / 2, y, text, ha="center", fontsize=8.5)
    return width


def draw_object(axes: Any, crops: np.ndarray, slot: int, x: float, y: float) -> float:
    """Draw an object token, the front crop above the top crop; return its width."""
    for view, (_, colour) in enumerate(VIEWS):
        top = y - SIZE + view * SIZE
        draw_picture(axes, picture(crops[view, slot]), x, top, (SIZE, SIZE))
        draw_frame(axes, x, top, (SIZE, SIZE), edgecolor=colour, linewidth=1.2)
    return SIZE


def draw_prompt(axes: Any, demo: Demonstration) -> None:
    """Draw the prompt, its encoder, and its scene image."""
    batch, stack = Processor(*preset("small").inputs).encode_prompts([demo.prompt])
    crops = stack.images()[batch.crop_index_VS]
    words = {number: word for word, number in benchmark_vocabulary().ids().items()} | {END_ID: "end"}
    draw_text(axes, LEFT, 0.62, "prompt", fontweight="bold")
    draw_text(axes, LEFT + 0.75, 0.62, f"“{demo.prompt.text}”", family="DejaVu Sans Mono", fontsize=8.5)
    x, middles = LEFT, []
    for word, entry in zip(batch.word_ids_BL[0].tolist(), batch.object_index_BL[0].tolist(), strict=True):
        if entry == WORD:
            width = draw_word(axes, words[word], x, 1.2)
        else:
            width = draw_object(axes, crops, entry, x, 1.2)
        middles.append(x + width / 2)
        x += width + 0.06
    end = x - 0.06
    draw_box(axes, LEFT, 1.78, (end - LEFT, 0.34), facecolor=LAYERS)
    draw_text(axes, (LEFT + end) / 2, 1.95, "correspondence with earlier images, text encoder", ha="center")
    for middle in middles:
        draw_arrow(axes, (middle, 1.6), (middle, 1.78))
    way = ((LEFT, 1.95), (0.55, 1.95), (0.55, 4.76), (LEFT, 4.76))
    draw_arrow(axes, *way, colour=INK, width=1.2)
    draw_text(axes, 0.42, 3.4, "cross-attention", rotation=90, ha="center", fontsize=8)
    shown = picture(prompt_scene(demo).rgb["top"])
    left, width = WIDTH - 0.25 - 2.4, 2.4
    draw_picture(axes, shown, left, 0.75, (width, width / 2))
    draw_frame(axes, left, 0.75, (width, width / 2), edgecolor=PROMPT)
    draw_text(axes, left, 0.62, "prompt scene, top view", fontsize=8, color=PROMPT)


def draw_step(axes: Any, demo: Demonstration) -> None:
    """Draw the first step: views, tokens, correspondence, decoder and outputs."""
    objects = observe(demo.observation(0))
    draw_text(axes, LEFT, 2.42, "step 1", fontweight="bold")
    width = 2.2
    for view, (name, colour) in enumerate(VIEWS):
        left = LEFT + view * (width + 0.1)
        draw_picture(axes, picture(demo.rgb[name][0]), left, 2.6, (width, width / 2))
        draw_frame(axes, left, 2.6, (width, width / 2), edgecolor=colour)
        draw_boxes(axes, objects, view, (left, 2.6, width), edgecolor="white", linewidth=0.8)
        draw_text(axes, left + 0.06, 2.7, name, fontsize=8, color=INK if view == 0 else "white", zorder=5)
    x = start = LEFT + 2 * width + 0.55
    middles = []
    for slot in range(len(objects)):
        middles.append(x + draw_object(axes, objects.crops, slot, x, 3.1) / 2)
        x += SIZE + 0.1
    right = WIDTH - 0.9
    middles.append(right + draw_word(axes, "query", right, 3.1) / 2)
    note = "one token per object: crops and boxes of both\nviews, end effector"
    draw_text(axes, start, 2.5, note, fontsize=8, color=FAINT, linespacing=1.3)
    note = "+ correspondence: attention by appearance to objects\nin view and prompt; relative "
    note += "position, rotation, size"
    draw_box(axes, start - 0.1, 3.68, (right - start - 0.05, 0.46), facecolor=LAYERS)
    draw_text(axes, start, 3.91, note, fontsize=8.5, linespacing=1.3)
    for middle in middles[:-1]:
        draw_arrow(axes, (middle, 3.5), (middle, 3.68))
        draw_arrow(axes, (middle, 4.14), (middle, 4.55))
    draw_arrow(axes, (middles[-1], 3.28), (middles[-1], 4.55))
    draw_text(
        axes,
        LEFT,
        4.32,
        "history: tokens of previous steps and actions",
        fontsize=8,
        color=FAINT,
    )
    draw_box(axes, LEFT, 4.55, (WIDTH - LEFT - 0.25, 0.42), facecolor=LAYERS)
    draw_text(axes, LEFT + 0.15, 4.76, "decoder: 4 × (cross-attention to the prompt, causal self-attention)")
    draw_arrow(axes, (middles[-1], 4.97), (middles[-1], 5.3), colour=OUTPUT, width=2)
    note = "output: object to pick · place candidate · offset · relative rotation"
    draw_text(axes, middles[-1] - 0.12, 5.13, note, ha="right", fontsize=8, color=OUTPUT)


def draw_boxes(
    axes: Any, objects: ObjectViews, view: int, region: tuple[float, float, float], **style: Any
) -> None:
    """Draw object boxes over a view with this left edge, upper edge and width."""
    left, top, width = region
    for slot in np.flatnonzero(objects.masks[view]):
        centre_x, centre_y, box_height, box_width = objects.boxes[view, slot] * width / TOP.width
        corner = (left + centre_x - box_width / 2, top + centre_y - box_height / 2)
        draw_frame(axes, *corner, (box_width, box_height), **style)


def draw_candidates(axes: Any, demo: Demonstration, step: int, x: float, title: str) -> None:
    """Draw the place candidates of one step over the top view, and the action."""
    top, width = 5.85, 4.35
    region = (x, top, width)
    draw_text(axes, x, top - 0.17, title, fontsize=9, fontweight="bold")
    draw_picture(axes, picture(demo.rgb["top"][step]), x, top, (width, width / 2))
    points_mm = GridCandidates(1).points_mm.numpy() / 1000
    points = np.concatenate([points_mm, np.zeros((len(points_mm), 1))], axis=1)
    for column, row in on_picture(points, region):
        axes.plot([column], [row], ".", color="white", alpha=0.55, markersize=3, zorder=3)
    draw_boxes(axes, observe(demo.observation(step)), 1, region, edgecolor="#4aa8e0", linewidth=1.6)
    scene = observe_prompt_image(prompt_scene(demo))
    draw_boxes(axes, scene, 1, region, edgecolor=PROMPT, linewidth=1.6, linestyle="--")
    if step:
        first = observe(demo.observation(0))
        draw_boxes(axes, first, 1, region, edgecolor="#b794f6", linewidth=1.6, linestyle=":")
    action = demo.actions[step]
    ends = [[*action.pose0_position[:2], 0.0], [*action.pose1_position[:2], 0.0]]
    start, end = (tuple(point) for point in on_picture(np.array(ends), region))
    draw_arrow(axes, start, end, colour="#3ddc97", width=2.2)


def on_picture(points: np.ndarray, region: tuple[float, float, float]) -> np.ndarray:
    """Project world positions onto a drawn top view."""
    left, top, width = region
    return project(points, TOP) * width / TOP.width + (left, top)


def draw_legend(axes: Any, entries: Sequence[tuple[str, str, str]]) -> None:
    """Draw the legend: text, colour and line style of each entry."""
    x, y = LEFT, HEIGHT - 0.2
    for text, colour, line in entries:
        if line == ".":
            axes.plot([x + 0.15], [y], ".", color=FAINT, markersize=5)
        else:
            axes.plot([x, x + 0.3], [y, y], color=colour, linewidth=2, linestyle=line)
        draw_text(axes, x + 0.38, y, text, fontsize=8.5)
        x += 0.38 + 0.079 * len(text) + 0.3


def draw() -> Figure:
    """Draw the figure; for print, use `draw().savefig("network.pdf")`."""
    demo = demonstration()
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, HEIGHT))
        axes = figure.add_axes((0, 0, 1, 1))
        draw_title(axes, 0.25, "openvima-small", "")
        draw_text(axes, 2.1, 0.25, "pointer network over objects and place candidates")
        draw_prompt(axes, demo)
        draw_step(axes, demo)
        draw_candidates(axes, demo, 0, LEFT, "“rearrange”: candidate from the prompt")
        last = demo.num_steps - 1
        draw_candidates(axes, demo, last, LEFT + 4.35 + 0.65, "“restore”: candidate from the first step")
        entries = (
            ("objects in view", "#4aa8e0", "-"),
            ("prompt objects", PROMPT, "--"),
            ("objects at the first step", "#b794f6", ":"),
            ("grid candidates", FAINT, "."),
            ("action", "#3ddc97", "-"),
        )
        draw_legend(axes, entries)
        axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
        axes.axis("off")
    return figure


if __name__ == "__main__":
    # without the matplotlib version, so that bytes depend on the picture only
    draw().savefig(Path(__file__).with_suffix(".png"), dpi=140, metadata={"Software": None})
