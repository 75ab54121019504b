"""Draw policy.png: the token sequences of the policies for one prompt and two steps.

Words, crops, patches and bins are the networks' inputs, as made by `Processor`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any  # observations are nested mappings; the type of matplotlib's axes is not public

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle

import openvima
from openvima.perception.objects import observe, whole_frames
from openvima.policies import preset
from openvima.policies.batch import WORD
from openvima.policies.nn.action_head import NUM_BINS, encode_bins
from openvima.policies.nn.actions import ACTION_PARTS, to_unit_range
from openvima.policies.nn.decoder import PrefixDecoderConfig
from openvima.policies.processor import Processor
from openvima.policies.tokenizer import END_ID, benchmark_vocabulary
from openvima.render import channels_last
from openvima.scene import PromptImage, RenderedPrompt

SEED = 21  # a scene whose objects differ in colour; any other will do
MISS_M = -0.2  # offset of the first place position along y, so that a second step follows
PATCH, PATCHES_IN_ROW, PATCHES = 32, 4, 8  # of a frame of 64 × 128 pixels

WIDTH, HEIGHT = 11.0, 13.1  # inches, as all coordinates below, from the upper left corner
LEFT, SECOND = 0.95, 6.1  # left margin, and left edge of the second step
GAP = 0.06  # between groups of small tokens
INK, FAINT, PAPER, SUMMARY = "#1f2933", "#77818c", "#eef1f4", "#5b6773"
FRONT, TOP, ACTION, OUTPUT, LAYERS = "#0072b2", "#d98200", "#00805c", "#9b2393", "#e9e4f1"
VIEWS = (("front", FRONT), ("top", TOP))
COMPONENTS = ("x", "y", "rotation x", "rotation y", "rotation z", "rotation w")
BASELINES = {
    "gato": ("VIMA-Gato", "16 tokens per pair of frames, one per patch; decoder with the prompt as prefix"),
    "flamingo": ("VIMA-Flamingo", "4 resampled tokens per pair of frames; cross-attention to the prompt"),
    "gpt": ("VIMA-GPT", "1 token per pair of frames; decoder with the prompt as prefix"),
}
STYLE = {"font.family": "DejaVu Sans", "font.size": 9, "text.color": INK}


@dataclass(frozen=True)
class Token:
    """A word or an image (an empty text: pooled frame features), its colour, and its label."""

    content: str | np.ndarray
    colour: str = FAINT
    name: str = ""


@dataclass(frozen=True)
class Story:
    """A prompt, two observations, and the bins of the actions that followed them."""

    prompt: RenderedPrompt
    observations: list[Mapping[str, Any]]
    bins: list[np.ndarray]


def play() -> Story:
    """Play an episode whose first action misses."""
    env = openvima.make("visual_manipulation", level="train").unwrapped
    observation, info = env.reset(seed=SEED)
    observations, bins = [], []
    for miss_m in (MISS_M, 0.0):
        action = env.oracle_decision().action
        x, y = action.pose1_position
        arrays = replace(action, pose1_position=(x, y + miss_m)).to_arrays()
        values = np.concatenate([arrays[part] for part in ACTION_PARTS]).astype(np.float64)
        observations.append(observation)
        bins.append(encode_bins(to_unit_range(torch.from_numpy(values))).numpy())
        observation, _, _, _, info = env.step(arrays)
    assert info["success"]
    return Story(env.prompt, observations, bins)


# From processor outputs to drawn tokens.


def prompt_tokens(processor: Processor, prompt: RenderedPrompt) -> list[Token]:
    """Return the tokens of a prompt."""
    batch, stack = processor.encode_prompts([prompt])
    crops, num_objects = stack.images()[batch.crop_index_VS], batch.crop_index_VS.shape[1]
    words = {number: word for word, number in benchmark_vocabulary().ids().items()} | {END_ID: "end"}
    return [
        Token(words[word])
        if index == WORD
        else image_token(processor, crops, index % num_objects, index // num_objects)
        for word, index in zip(batch.word_ids_BL[0].tolist(), batch.object_index_BL[0].tolist(), strict=True)
    ]


def step_tokens(processor: Processor, observation: Mapping[str, Any]) -> list[Token]:
    """Return the tokens of an observation."""
    batch, stack = processor.encode_observations([[observation]])
    crops = stack.images()[batch.crop_index_BTVN[0, 0]]
    if processor.layout == "frames":
        return [image_token(processor, crops, 0, part) for part in range(processor.tokens_per_image)]
    slots = [(k, view) for view in range(len(VIEWS)) for k in range(crops.shape[1])]
    return [replace(image_token(processor, crops, k, view), name=str(k + 1)) for k, view in slots]


def image_token(processor: Processor, crops: np.ndarray, entry: int, part: int) -> Token:
    """Return one token of an image: a crop, a patch, or a blank for pooled frames."""
    if processor.layout == "views":
        name, colour = VIEWS[part]
        return Token(picture(crops[part, entry]), colour, f"{chr(ord('A') + entry)} {name}")
    if processor.tokens_per_image < 2 * PATCHES:
        return Token("", SUMMARY)
    view, place = divmod(part, PATCHES)
    row, column = (PATCH * index for index in divmod(place, PATCHES_IN_ROW))
    frame = crops[view, entry]
    return Token(picture(frame[:, row : row + PATCH, column : column + PATCH]), VIEWS[view][1])


def picture(image: np.ndarray) -> np.ndarray:
    """Turn (3, height, width) into (height, width, 3)."""
    return channels_last(image)


# Drawing.


def draw_text(axes: Any, x: float, y: float, text: str, **style: Any) -> None:
    """Write text, by default left-aligned and vertically centred."""
    axes.text(x, y, text, **{"va": "center"} | style)


def draw_box(axes: Any, x: float, y: float, size: tuple[float, float], **style: Any) -> None:
    """Draw a rounded box; x and y are its upper left corner."""
    style = {"facecolor": PAPER, "edgecolor": FAINT, "linewidth": 0.8, "zorder": 2} | style
    shape = f"round,pad=0,rounding_size={min(0.07, min(size) / 4)}"
    axes.add_patch(FancyBboxPatch((x, y), *size, boxstyle=shape, **style))


def draw_frame(axes: Any, x: float, y: float, size: tuple[float, float], **style: Any) -> None:
    """Draw a rectangle that is not filled."""
    axes.add_patch(Rectangle((x, y), *size, fill=False, **{"zorder": 3} | style))


def draw_picture(axes: Any, image: np.ndarray, x: float, y: float, size: tuple[float, float]) -> None:
    """Draw an image."""
    extent = (x, x + size[0], y + size[1], y)
    axes.imshow(image, extent=extent, interpolation="nearest", zorder=2)


def draw_arrow(axes: Any, *points: tuple[float, float], colour: str = FAINT, width: float = 0.8) -> None:
    """Draw a line through points, with a head at the last one."""
    line = {"color": colour, "linewidth": width, "zorder": 4}
    axes.plot(*zip(*points[:-1], strict=True), solid_joinstyle="miter", **line)
    head = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9, **line}
    axes.annotate("", points[-1], points[-2], arrowprops=head, zorder=4)


def draw_tokens(axes: Any, tokens: Sequence[Token], x: float, y: float, size: float) -> list[float]:
    """Draw tokens from left to right, images as squares with their middle at y.

    Returns:
        The centre of each token, then the right edge of the last one.
    """
    large = size > 0.3
    gap = 0.06 if large else 0.025
    middles = []
    for token in tokens:
        width, height = size, size
        if isinstance(token.content, str):
            if token.content:
                width = max(0.2, 0.13 + 0.078 * max(map(len, token.content.split("\n"))))
                height = max(size, 0.25)
            fill = PAPER if token.content else token.colour
            draw_box(axes, x, y - height / 2, (width, height), facecolor=fill, edgecolor=token.colour)
            colour = ACTION if token.colour == ACTION else INK
            draw_text(axes, x + width / 2, y, token.content, ha="center", fontsize=8.5, color=colour)
        else:
            draw_picture(axes, token.content, x, y - size / 2, (size, size))
            style = {"edgecolor": token.colour, "linewidth": 1.8 if large else 0.7}
            draw_frame(axes, x, y - size / 2, (size, size), **style)
        style = {"ha": "center", "fontsize": 8, "color": token.colour}
        draw_text(axes, x + width / 2, y - size / 2 - 0.1, token.name, **style)
        middles.append(x + width / 2)
        x += width + gap
    return [*middles, x - gap]


def draw_title(axes: Any, y: float, name: str, text: str) -> None:
    """Write the name of a policy and its summary."""
    draw_text(axes, 0.2, y, name, fontsize=11, fontweight="bold")
    draw_text(axes, 1.75, y, text)


def draw_vima(axes: Any, story: Story) -> None:
    """Draw prompt, two steps and outputs of VIMA."""
    processor = Processor(*preset("vima-nano").inputs)
    draw_title(axes, 0.25, "VIMA", "one token per object and view; cross-attention to the prompt")
    draw_prompt(axes, processor, story.prompt)
    draw_text(axes, LEFT, 2.68, "history", fontweight="bold")
    steps = zip((LEFT, SECOND), story.observations, story.bins, strict=True)
    for number, (left, observation, bins) in enumerate(steps, 1):
        draw_views(axes, observation, left, number)
        note = "per object: 32 × 32 crop and bounding box"
        draw_text(axes, left, 4.25, note, fontsize=8, color=FAINT)
        *middles, end = draw_tokens(axes, step_tokens(processor, observation), left, 4.9, 0.58)
        draw_text(axes, left, 5.3, "fused with the end effector: suction cup", fontsize=8, color=FAINT)
        for middle in middles:
            draw_arrow(axes, (middle, 5.4), (middle, 5.6))
        draw_action(axes, bins, left, middles[-1], number)
        if number == 1:
            draw_past_action(axes, end)
    draw_box(axes, LEFT, 5.6, (WIDTH - LEFT - 0.25, 0.46), facecolor=LAYERS)
    draw_text(axes, LEFT + 0.15, 5.83, "decoder: n × (cross-attention to the prompt, causal self-attention)")


def draw_prompt(axes: Any, processor: Processor, prompt: RenderedPrompt) -> None:
    """Draw the prompt and its encoder."""
    draw_text(axes, LEFT, 0.62, "prompt", fontweight="bold")
    draw_text(axes, SECOND + 0.3, 1.1, f"“{prompt.text}”", family="DejaVu Sans Mono", fontsize=8.5)
    note = "A, B: objects of the two prompt images,\nin front and top view"
    draw_text(axes, SECOND + 0.3, 1.5, note, fontsize=8.5, linespacing=1.4)
    *middles, end = draw_tokens(axes, prompt_tokens(processor, prompt), LEFT, 1.15, 0.58)
    draw_box(axes, LEFT, 1.65, (end - LEFT, 0.38), facecolor=LAYERS)
    draw_text(axes, (LEFT + end) / 2, 1.84, "text encoder (T5)", ha="center")
    for middle in middles:
        draw_arrow(axes, (middle, 1.45), (middle, 1.65))
        draw_arrow(axes, (middle, 2.03), (middle, 2.2))
        draw_box(axes, middle - 0.09, 2.2, (0.18, 0.18), facecolor=LAYERS)
    draw_text(axes, end + 0.12, 2.29, "keys and values, computed once per episode", fontsize=8)
    way = ((middles[0] - 0.12, 2.29), (0.55, 2.29), (0.55, 5.83), (LEFT, 5.83))
    draw_arrow(axes, *way, colour=INK, width=1.2)
    draw_text(axes, 0.42, 4.1, "cross-attention", rotation=90, ha="center", fontsize=8)


def draw_views(axes: Any, observation: Mapping[str, Any], x: float, number: int) -> None:
    """Draw both views of a step, with the boxes of the objects in them."""
    objects = observe(observation)
    width, top = 2.2, 3.0
    for view, (name, colour) in enumerate(VIEWS):
        left = x + view * (width + 0.1)
        draw_text(axes, left, top - 0.12, f"step {number}, {name} view", fontsize=8, color=colour)
        draw_picture(axes, picture(observation["rgb"][name]), left, top, (width, width / 2))
        draw_frame(axes, left, top, (width, width / 2), edgecolor=colour)
        for k in np.flatnonzero(objects.masks[view]):
            centre_x, centre_y, box_height, box_width = objects.boxes[view, k] * width / 256
            corner = (left + centre_x - box_width / 2, top + centre_y - box_height / 2)
            draw_frame(axes, *corner, (box_width, box_height), edgecolor="white", linewidth=0.8)
            ground = {"facecolor": INK, "edgecolor": "none", "pad": 1}
            style = {"color": "white", "fontsize": 7.5, "zorder": 4, "bbox": ground}
            draw_text(axes, corner[0] + 0.02, corner[1] - 0.09, str(k + 1), **style)


def draw_action(axes: Any, bins: np.ndarray, x: float, middle: float, number: int) -> None:
    """Draw the output token and its action bins."""
    draw_arrow(axes, (middle, 6.06), (middle, 6.5), colour=OUTPUT, width=2)
    note = "output: 12 action bins"
    draw_text(axes, middle - 0.12, 6.28, note, ha="right", fontsize=8, color=OUTPUT)
    draw_box(axes, x, 6.5, (4.6, 1.45), facecolor="white", edgecolor=OUTPUT)
    for component, (count, chosen) in enumerate(zip(NUM_BINS, bins, strict=True)):
        pose, row = divmod(component, len(COMPONENTS))
        left, y, width = x + 0.12 + 2.3 * pose, 6.82 + 0.19 * row, 0.9
        if row == 0:
            title = f"action {number}, {('pick', 'place')[pose]}"
            draw_text(axes, left, y - 0.18, title, fontsize=8, color=OUTPUT)
        draw_text(axes, left, y, COMPONENTS[row], fontsize=7.5)
        draw_box(axes, left + 0.68, y - 0.05, (width, 0.1), linewidth=0.4)
        mark = left + 0.68 + (width - 0.04) * chosen / (count - 1)
        axes.add_patch(Rectangle((mark, y - 0.07), 0.04, 0.14, color=OUTPUT, zorder=3))
        draw_text(axes, left + 1.64, y, f"{chosen} / {count}", fontsize=7.5)


def draw_past_action(axes: Any, end: float) -> None:
    """Draw the token of the first action in the history."""
    middle, end = draw_tokens(axes, [Token("action\n1", ACTION)], end + 0.06, 4.9, 0.58)
    draw_arrow(axes, (middle, 5.4), (middle, 5.6))
    way = ((LEFT + 4.6, 7.2), (end + 0.15, 7.2), (end + 0.15, 4.9), (end + 0.01, 4.9))
    draw_arrow(axes, *way, colour=ACTION, width=1.5)


def draw_baselines(axes: Any, story: Story) -> None:
    """Draw the token sequences of the baselines."""
    heading = "Baselines on the same episode: whole frames, front and top, of 64 × 128 pixels"
    axes.plot((0.2, WIDTH - 0.25), (8.2, 8.2), color=FAINT, linewidth=0.8)
    draw_text(axes, 0.2, 8.4, heading, fontweight="bold")
    for y, (architecture, (name, text)) in zip((8.82, 10.25, 11.65), BASELINES.items(), strict=True):
        draw_title(axes, y, name, text)
        draw_baseline(axes, story, architecture, y)


def draw_baseline(axes: Any, story: Story, architecture: str, y: float) -> None:
    """Draw the tokens of one baseline below its title: all in one sequence, or prompt and history apart."""
    config = preset(f"{architecture}-nano")
    processor = Processor(*config.inputs)
    images = [stacked(part.rgb) for part in story.prompt.sequence() if isinstance(part, PromptImage)]
    is_patches = architecture == "gato"
    x, y = LEFT, y + (0.32 if is_patches else 0.9)
    for is_image, group in groupby(
        prompt_tokens(processor, story.prompt), lambda token: token.colour != FAINT
    ):
        x = draw_group(axes, list(group), x, y, images.pop(0) if is_image else None)[-1] + GAP
    if is_patches:  # too long for one line
        draw_text(axes, x, y, "…")
        x, y = LEFT, y + 0.42
        draw_text(axes, x - 0.15, y, "…", ha="right")
    if isinstance(config.decoder, PrefixDecoderConfig):
        x = draw_group(axes, [Token("separator")], x, y)[-1] + GAP
    else:
        draw_text(axes, x + 0.7, y - 0.13, "cross-attention", ha="center", fontsize=8)
        draw_arrow(axes, (x + 0.02, y), (x + 1.38, y), colour=INK, width=1.2)
        x += 1.45
    for number, observation in enumerate(story.observations, 1):
        *middles, end = draw_group(
            axes, step_tokens(processor, observation), x, y, stacked(observation["rgb"])
        )
        draw_arrow(axes, (middles[-1], y + 0.12), (middles[-1], y + 0.36), colour=OUTPUT, width=1.5)
        draw_text(
            axes, middles[-1] - 0.08, y + 0.25, f"action {number}", ha="right", fontsize=8, color=OUTPUT
        )
        if number == 1:
            *_, end = draw_group(axes, [Token("action 1", ACTION)], end + GAP, y)
        x = end + GAP


def draw_group(
    axes: Any, tokens: Sequence[Token], x: float, y: float, frames: np.ndarray | None = None
) -> list[float]:
    """Draw words, patches, or a pair of frames above their tokens; return as `draw_tokens`."""
    is_summary = frames is not None and isinstance(tokens[0].content, str)
    if not is_summary:
        return draw_tokens(axes, tokens, x, y, 0.205)
    side, size = 0.5, 0.16
    width = (size + 0.025) * len(tokens) - 0.025
    whole = max(side, width)
    left = x + (whole - side) / 2
    draw_picture(axes, frames, left, y - 0.13 - side, (side, side))
    draw_frame(axes, left, y - 0.13 - side, (side, side), edgecolor=SUMMARY, linewidth=0.6)
    *middles, _ = draw_tokens(axes, tokens, x + (whole - width) / 2, y, size)
    return [*middles, x + whole]


def stacked(rgb: Mapping[str, np.ndarray]) -> np.ndarray:
    """Stack both frames of the baselines' input vertically."""
    return picture(np.concatenate(list(whole_frames(rgb).crops[:, 0]), axis=1))


def draw() -> Figure:
    """Draw the figure; for print, use `draw().savefig("policy.pdf")`."""
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, HEIGHT))
        axes = figure.add_axes((0, 0, 1, 1))
        story = play()
        draw_vima(axes, story)
        draw_baselines(axes, story)
        axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
        axes.axis("off")
    return figure


if __name__ == "__main__":
    # without the matplotlib version, so that bytes depend on the picture only
    draw().savefig(Path(__file__).with_suffix(".png"), dpi=160, metadata={"Software": None})
