"""Make openvima_small_network.png beside this file: what it reads, and where places come from.

Words, crops, boxes and free points are those that the network gets; actions are the oracle's.
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
from openvima.policies.tokenizer import END_ID, word_ids
from openvima.render.camera import TOP, project
from openvima.scene import PromptImage
from policy import (
    FAINT,
    INK,
    LAYERS,
    PAPER,
    READ,
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

TASK, SEED = "rearrange_then_restore", 10  # one object is brought to its place, and back
WIDTH, HEIGHT = 11.0, 8.42  # inches, as all places below, from the upper left corner
LEFT, SIZE = 0.95, 0.36  # where rows begin; side of a crop
SHOWN, AT_FIRST = "#d98200", "#8250c4"  # places in the prompt, and those at the first step


def demonstration() -> Demonstration:
    """Let the oracle play the episode."""
    return rollout_oracle(TabletopEnv(TASK, level="train"), SEED)


def prompt_scene(demo: Demonstration) -> PromptImage:
    """Return the picture of a scene in the prompt."""
    return next(p for p in demo.prompt.sequence() if isinstance(p, PromptImage) and p.kind == "scene")


def draw_word(axes: Any, text: str, x: float, y: float) -> float:
    """Draw a word as a token with its middle at y; return its width."""
    width = max(0.24, 0.13 + 0.078 * len(text))
    draw_box(axes, x, y - 0.18, (width, 0.36), facecolor=PAPER)
    draw_text(axes, x + width / 2, y, text, ha="center", fontsize=8.5)
    return width


def draw_object(axes: Any, crops: np.ndarray, slot: int, x: float, y: float) -> float:
    """Draw an object as a token, the front view above the top view; return its width."""
    for view, (_, colour) in enumerate(VIEWS):
        top = y - SIZE + view * SIZE
        draw_picture(axes, picture(crops[view, slot]), x, top, (SIZE, SIZE))
        draw_frame(axes, x, top, (SIZE, SIZE), edgecolor=colour, linewidth=1.2)
    return SIZE


def draw_prompt(axes: Any, demo: Demonstration) -> None:
    """Draw the prompt, its encoder, and the scene that it shows."""
    batch, stack = Processor.of(preset("small").inputs).encode_prompts([demo.prompt])
    crops = stack.images()[batch.crop_index_VS]
    words = {number: word for word, number in word_ids().items()} | {END_ID: "end"}
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
    draw_text(
        axes, (LEFT + end) / 2, 1.95, "comparisons with earlier images, then a text encoder", ha="center"
    )
    for middle in middles:
        draw_arrow(axes, (middle, 1.6), (middle, 1.78))
    way = ((LEFT, 1.95), (0.55, 1.95), (0.55, 4.76), (LEFT, 4.76))
    draw_arrow(axes, *way, colour=INK, width=1.2)
    draw_text(axes, 0.42, 3.4, "cross-attention", rotation=90, ha="center", fontsize=8)
    shown = picture(prompt_scene(demo).rgb["top"])
    left, width = WIDTH - 0.25 - 2.4, 2.4
    draw_picture(axes, shown, left, 0.75, (width, width / 2))
    draw_frame(axes, left, 0.75, (width, width / 2), edgecolor=SHOWN)
    draw_text(axes, left, 0.62, "the scene in the prompt, top view", fontsize=8, color=SHOWN)


def draw_step(axes: Any, demo: Demonstration) -> None:
    """Draw the first step: views, tokens, comparisons, decoder and what is read."""
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
    note = "one token an object: both crops, both boxes,\nthe end effector"
    draw_text(axes, start, 2.5, note, fontsize=8, color=FAINT, linespacing=1.3)
    note = "+ comparisons: how it differs from what looks most\nlike it, in view and in the prompt: "
    note += "place, turn, size"
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
        "history: earlier steps and actions, as tokens before these",
        fontsize=8,
        color=FAINT,
    )
    draw_box(axes, LEFT, 4.55, (WIDTH - LEFT - 0.25, 0.42), facecolor=LAYERS)
    draw_text(axes, LEFT + 0.15, 4.76, "decoder: 4 × (cross-attention to the prompt, causal self-attention)")
    draw_arrow(axes, (middles[-1], 4.97), (middles[-1], 5.3), colour=READ, width=2)
    note = "read here: which object to pick · which place to copy · offset · turn"
    draw_text(axes, middles[-1] - 0.12, 5.13, note, ha="right", fontsize=8, color=READ)


def draw_boxes(
    axes: Any, objects: ObjectViews, view: int, place: tuple[float, float, float], **style: Any
) -> None:
    """Draw boxes of objects over a picture that was drawn at a place: left, upper edge, width."""
    left, top, width = place
    for slot in np.flatnonzero(objects.masks[view]):
        centre_x, centre_y, box_height, box_width = objects.boxes[view, slot] * width / TOP.width
        corner = (left + centre_x - box_width / 2, top + centre_y - box_height / 2)
        draw_frame(axes, *corner, (box_width, box_height), **style)


def draw_places(axes: Any, demo: Demonstration, step: int, x: float, title: str) -> None:
    """Draw the candidates for a place at one step over the top view, and the action."""
    top, width = 5.85, 4.35
    place = (x, top, width)
    draw_text(axes, x, top - 0.17, title, fontsize=9, fontweight="bold")
    draw_picture(axes, picture(demo.rgb["top"][step]), x, top, (width, width / 2))
    points_mm = GridCandidates(1).points_mm.numpy() / 1000
    points = np.concatenate([points_mm, np.zeros((len(points_mm), 1))], axis=1)
    for column, row in on_picture(points, place):
        axes.plot([column], [row], ".", color="white", alpha=0.55, markersize=3, zorder=3)
    draw_boxes(axes, observe(demo.observation(step)), 1, place, edgecolor="#4aa8e0", linewidth=1.6)
    scene = observe_prompt_image(prompt_scene(demo))
    draw_boxes(axes, scene, 1, place, edgecolor=SHOWN, linewidth=1.6, linestyle="--")
    if step:
        first = observe(demo.observation(0))
        draw_boxes(axes, first, 1, place, edgecolor="#b794f6", linewidth=1.6, linestyle=":")
    action = demo.actions[step]
    ends = [[*action.pose0_position[:2], 0.0], [*action.pose1_position[:2], 0.0]]
    start, end = (tuple(point) for point in on_picture(np.array(ends), place))
    draw_arrow(axes, start, end, colour="#3ddc97", width=2.2)


def on_picture(points: np.ndarray, place: tuple[float, float, float]) -> np.ndarray:
    """Return where positions in the world lie on a picture of the top view."""
    left, top, width = place
    return project(points, TOP) * width / TOP.width + (left, top)


def draw_legend(axes: Any, entries: Sequence[tuple[str, str, str]]) -> None:
    """Write what the frames mean: text, colour and style of the line of each."""
    x, y = LEFT, HEIGHT - 0.2
    for text, colour, line in entries:
        if line == ".":
            axes.plot([x + 0.15], [y], ".", color=FAINT, markersize=5)
        else:
            axes.plot([x, x + 0.3], [y, y], color=colour, linewidth=2, linestyle=line)
        draw_text(axes, x + 0.38, y, text, fontsize=8.5)
        x += 0.38 + 0.079 * len(text) + 0.3


def draw() -> Figure:
    """Draw all of it; `draw().savefig("network.pdf")` gives it in a form for print."""
    demo = demonstration()
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, HEIGHT))
        axes = figure.add_axes((0, 0, 1, 1))
        draw_title(axes, 0.25, "openvima-small", "")
        draw_text(axes, 2.1, 0.25, "it points at an object, and at a place that it has seen")
        draw_prompt(axes, demo)
        draw_step(axes, demo)
        draw_places(axes, demo, 0, LEFT, "“rearrange”: a place that the prompt shows")
        last = demo.num_steps - 1
        draw_places(axes, demo, last, LEFT + 4.35 + 0.65, "“restore”: a place of the first step")
        entries = (
            ("in view", "#4aa8e0", "-"),
            ("in the prompt", SHOWN, "--"),
            ("at the first step", "#b794f6", ":"),
            ("free points", FAINT, "."),
            ("the action", "#3ddc97", "-"),
        )
        draw_legend(axes, entries)
        axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
        axes.axis("off")
    return figure


if __name__ == "__main__":
    # without the version of matplotlib, so that the bytes change with the picture only
    draw().savefig(Path(__file__).with_suffix(".png"), dpi=140, metadata={"Software": None})
