"""Draw midas.png: the tokens of a step, a demonstration relabelled for inverse dynamics, in-context prompts.

Words, crops and bins are the network's inputs.
"""

from pathlib import Path
from typing import Any  # the type of matplotlib's axes is not public

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure

from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.evaluation.prompt_ablations import in_context_prompt
from openvima.policies import preset
from openvima.policies.nn.action_head import encode_bins
from openvima.policies.nn.actions import ACTION_PARTS, to_unit_range
from openvima.policies.processor import Processor
from openvima.scene import Action
from openvima.training.augmentation.prompts import motion_prompt
from policy import (
    ACTION,
    FAINT,
    LAYERS,
    OUTPUT,
    STYLE,
    VIEWS,
    Token,
    draw_arrow,
    draw_box,
    draw_frame,
    draw_picture,
    draw_text,
    draw_title,
    draw_tokens,
    picture,
    prompt_tokens,
    step_tokens,
)

SEED = 21  # a scene whose objects differ in colour; any other will do
MOTION_SEED = 1
IN_CONTEXT_SEEDS = {"twist": 4, "follow_order": 6}
WIDTH, HEIGHT = 13.6, 8.6  # inches, as all coordinates below, from the upper left corner
LEFT, SIZE = 0.25, 0.34  # left margin; side of a crop
NAMES = ("x", "y", "qx", "qy", "qz", "qw")
RESIDUAL = "#b3541e"


def demonstration(task: str, seed: int) -> Demonstration:
    """Return an oracle rollout."""
    return rollout_oracle(TabletopEnv(task, level="train"), seed)


def bins_of(action: Action) -> list[int]:
    """Return the bins of an action's twelve components."""
    arrays = action.to_arrays()
    values = np.concatenate([arrays[part] for part in ACTION_PARTS]).astype(np.float64)
    return encode_bins(to_unit_range(torch.from_numpy(values))).tolist()


def component_tokens(action: Action) -> list[Token]:
    """Return the twelve tokens of an action: its bins."""
    names = [name + "₀" for name in NAMES] + [name + "₁" for name in NAMES]
    return [Token(str(number), ACTION, name) for number, name in zip(bins_of(action), names, strict=True)]


def draw_step(axes: Any, demo: Demonstration) -> None:
    """Draw prompt, first observation and first action as one sequence."""
    processor = Processor(*preset("midas-nano").inputs)
    text = "decoder over encoded prompt and history; autoregressive action decoding"
    draw_title(axes, 0.25, "MIDAS", text)
    draw_text(axes, LEFT, 0.62, f"“{demo.prompt.text}”", family="DejaVu Sans Mono", fontsize=8)
    tokens = prompt_tokens(processor, demo.prompt)
    shown = [token if isinstance(token.content, str) else _unnamed(token) for token in tokens]
    *middles, end = draw_tokens(axes, shown, LEFT, 1.1, SIZE)
    draw_box(axes, LEFT, 1.42, (end - LEFT, 0.34), facecolor=LAYERS)
    draw_text(axes, (middles[4] + middles[5]) / 2, 1.59, "text encoder", ha="center")
    for token, middle in zip(tokens, middles, strict=True):
        draw_arrow(axes, (middle, 1.29), (middle, 1.42))
        draw_arrow(axes, (middle, 1.76), (middle, 2.22))
        if not isinstance(token.content, str):
            way = ((middle + 0.1, 1.29), (middle + 0.1, 1.95), (middle + 0.01, 1.95))
            draw_arrow(axes, *way, colour=RESIDUAL, width=1.3)
    draw_text(axes, end + 0.06, 1.95, "visual residual", fontsize=8, color=RESIDUAL)
    separator, right = draw_tokens(axes, [Token("sep")], end + 1.1, 1.1, SIZE)
    start = right + 0.12
    seen = [_unnamed(token) for token in step_tokens(processor, demo.observation(0))]
    *slots, right = draw_tokens(axes, seen, start, 1.1, SIZE)
    for name, colour, at in ((*VIEWS[0], start), (*VIEWS[1], slots[len(slots) // 2] - SIZE / 2)):
        draw_text(axes, at, 0.82, f"step 1, {name}", fontsize=8, color=colour)
    *actions, right = draw_tokens(axes, component_tokens(demo.actions[0]), right + 0.12, 1.1, SIZE)
    draw_text(axes, actions[0] - 0.1, 0.62, "action 1: pick, then place", fontsize=8, color=ACTION)
    for middle in (separator, *slots, *actions):
        draw_arrow(axes, (middle, 1.29), (middle, 2.22))
    draw_box(axes, LEFT, 2.22, (right - LEFT, 0.4), facecolor=LAYERS)
    note = "decoder: 2n × causal self-attention"
    draw_text(axes, LEFT + 0.1, 2.42, note)
    names = [token.name for token in component_tokens(demo.actions[0])]
    for middle, name in zip((slots[-1], *actions[:-1]), names, strict=True):
        draw_arrow(axes, (middle, 2.62), (middle, 2.86), colour=OUTPUT, width=1.5)
        draw_text(axes, middle, 2.98, name, ha="center", fontsize=8.5, color=OUTPUT)
    note = "autoregressive: each decoded component is the input token for the next one"
    draw_text(axes, slots[-1] - 0.15, 3.0, note, ha="right", fontsize=8, color=OUTPUT)


def draw_motion(axes: Any, demo: Demonstration) -> None:
    """Draw a demonstration and its inverse-dynamics prompt."""
    axes.plot((0.2, WIDTH - 0.25), (3.3, 3.3), color=FAINT, linewidth=0.8)
    title = "Inverse dynamics: predict the actions between frames"
    draw_text(axes, 0.2, 3.52, title, fontsize=11, fontweight="bold")
    draw_text(axes, 5.2, 3.52, f"original prompt: “{demo.prompt.text}”", fontsize=8, color=FAINT)
    width = 2.6
    for t in range(demo.num_steps + 1):
        x = LEFT + t * (width + 1.5)
        draw_picture(axes, picture(demo.rgb["front"][t]), x, 3.8, (width, width / 2))
        draw_frame(axes, x, 3.8, (width, width / 2), edgecolor=VIEWS[0][1])
        draw_text(axes, x + 0.06, 3.92, f"frame {t}", fontsize=8, zorder=4)
        if t < demo.num_steps:
            draw_arrow(axes, (x + width + 0.1, 4.45), (x + width + 1.4, 4.45), colour=ACTION, width=1.6)
            draw_text(axes, x + width + 0.75, 4.3, f"action {t + 1}", ha="center", fontsize=8.5, color=ACTION)
    processor = Processor(*preset("midas-nano").inputs)
    frames = [demo.observation(t) for t in range(demo.num_steps + 1)]
    tokens = [_unnamed(token) for token in prompt_tokens(processor, motion_prompt(frames, demo.objects))]
    draw_text(axes, LEFT, 5.4, "prompt", fontweight="bold")
    *_, end = draw_tokens(axes, tokens, LEFT, 5.72, 0.26)
    draw_text(axes, LEFT, 6.12, "target", fontweight="bold")
    x = LEFT + 0.8
    for number, action in enumerate(demo.actions, 1):
        draw_text(axes, x, 6.12, f"action {number}:", fontsize=8.5, color=ACTION)
        plain = [Token(token.content, ACTION) for token in component_tokens(action)]
        x = draw_tokens(axes, plain, x + 0.75, 6.12, 0.26)[-1] + 0.35
    assert end < WIDTH  # the whole prompt fits


def draw_in_context(axes: Any) -> None:
    """Draw two prompts of in-context evaluation, each with the start of its episode."""
    axes.plot((0.2, WIDTH - 0.25), (6.5, 6.5), color=FAINT, linewidth=0.8)
    title = "In-context evaluation: prompts of untrained tasks are edited to contain an example"
    draw_text(axes, 0.2, 6.72, title, fontsize=11, fontweight="bold")
    size, x = (1.5, 0.75), LEFT
    for task, seed in IN_CONTEXT_SEEDS.items():
        env = TabletopEnv(task, level="L1", domain="eval")
        observation = env.reset(seed=seed)[0]
        prompt = in_context_prompt(env.prompt, task)
        draw_text(axes, x, 7.05, task, fontweight="bold")
        draw_text(axes, x, 7.28, f"“{prompt.text}”", family="DejaVu Sans Mono", fontsize=7)
        shown = [(name, image.rgb, VIEWS[1][1]) for name, image in prompt.images.items()]
        for name, rgb, colour in (*shown, ("first observation", observation["rgb"], FAINT)):
            draw_picture(axes, picture(rgb["top"]), x, 7.45, size)
            draw_frame(axes, x, 7.45, size, edgecolor=colour)
            draw_text(axes, x, 8.32, name, fontsize=8, color=colour)
            x += size[0] + 0.15
        x += 1.2


def _unnamed(token: Token) -> Token:
    return Token(token.content, token.colour)


def draw() -> Figure:
    """Draw the figure; for print, use `draw().savefig("midas.pdf")`."""
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, HEIGHT))
        axes = figure.add_axes((0, 0, 1, 1))
        draw_step(axes, demonstration("visual_manipulation", SEED))
        draw_motion(axes, demonstration("manipulate_old_neighbor", MOTION_SEED))
        draw_in_context(axes)
        axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
        axes.axis("off")
    return figure


if __name__ == "__main__":
    # without the matplotlib version, so that bytes depend on the picture only
    draw().savefig(Path(__file__).with_suffix(".png"), dpi=140, metadata={"Software": None})
