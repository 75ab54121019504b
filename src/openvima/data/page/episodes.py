"""One episode on the data page: its prompt, and its observations with the actions drawn in."""

import math

import numpy as np
from PIL import Image

from openvima.data.records import Demonstration
from openvima.data.schema import IMAGE_SHAPE, VIEWS
from openvima.render import channels_last
from openvima.render.camera import CAMERAS, View, project
from openvima.scene import BACKGROUND_ID, Action, PromptImage
from openvima.video.clips import png

_GAP = 2  # pixels between the two views
_MARGIN = 3  # pixels around an object in the prompt
_RING = 4.5  # radius in pixels
_HEAD = 7.0  # length of the arrow's head in pixels
_LEAST_TURN_DEG = 1


def episode_card(demo: Demonstration) -> dict[str, object]:
    """Values of the template `episode`: prompt, frames, and facts.

    Args:
        demo: The episode, with its images.
    """
    facts = (
        f"level {demo.level}",
        f"seed {demo.seed} of domain {demo.domain}",
        demo.end_effector,
        *([f"{demo.num_redraws} resamples"] if demo.num_redraws else []),
        "solved" if demo.outcome.success else demo.outcome.reason or "not solved",
    )
    return {
        "prompt": [part if isinstance(part, str) else _prompt_image(part) for part in demo.prompt.sequence()],
        "frames": [_frame(demo, step) for step in range(demo.num_steps + 1)],
        "size": (IMAGE_SHAPE[1], 2 * IMAGE_SHAPE[0] + _GAP),
        "facts": facts,
        "content_hash": demo.content_hash(),
    }


def _prompt_image(image: PromptImage) -> dict[str, object]:
    pixels = channels_last(image.rgb["front"])
    if image.kind == "object":
        pixels = _cut_to_object(pixels, image.segm["front"])
    return {"png": _png(pixels), "kind": image.kind, "name": image.name}


def _png(pixels: np.ndarray) -> bytes:
    return png(Image.fromarray(np.ascontiguousarray(pixels)))


def _cut_to_object(pixels: np.ndarray, segm: np.ndarray) -> np.ndarray:
    shown = segm != BACKGROUND_ID
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    if not len(rows):
        return pixels
    top, left = max(0, rows[0] - _MARGIN), max(0, columns[0] - _MARGIN)
    return pixels[top : rows[-1] + 1 + _MARGIN, left : columns[-1] + 1 + _MARGIN]


def _frame(demo: Demonstration, step: int) -> dict[str, object]:
    """Observation of both cameras before a step, or at the end, with the action that follows."""
    height, width = IMAGE_SHAPE
    image = np.full((2 * height + _GAP, width, 3), 255, np.uint8)
    for index, view in enumerate(VIEWS):
        top = index * (height + _GAP)
        image[top : top + height] = channels_last(demo.rgb[view][step])
    arrows = [_arrow(action, view) for action in demo.actions[step : step + 1] for view in VIEWS]
    return {"caption": _caption(demo, step), "png": _png(image), "arrows": arrows}


def _arrow(action: Action, view: View) -> dict[str, object]:
    """A ring where the tool goes down, and an arrow to where it goes up again."""
    points = np.array([(*action.pose0_position, 0.0), (*action.pose1_position, 0.0)])
    start, end = project(points, CAMERAS[view]) + 0.5  # the middle of a pixel, as SVG counts
    below = np.array([0, VIEWS.index(view) * (IMAGE_SHAPE[0] + _GAP)])
    start, end = start + below, end + below
    way = end - start
    length = float(np.hypot(*way))
    ring: dict[str, object] = {"x": start[0], "y": start[1], "radius": _RING, "path": ""}
    if length <= _RING:  # it stays where it is, and turns
        return ring
    forward = way / length
    side = np.array([-forward[1], forward[0]])
    wings = [end - _HEAD * forward + sign * _HEAD / 2 * side for sign in (1, -1)]
    path = _path([start + _RING * forward, end]) + _path([wings[0], end, wings[1]])
    return {**ring, "path": path}


def _path(points: list[np.ndarray]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)


def _caption(demo: Demonstration, step: int) -> str:
    if step == demo.num_steps:
        return "at the end"
    action, names = demo.actions[step], {o.object_id: f"{o.texture} {o.object}" for o in demo.objects}
    pick_id, place_id = demo.pick_ids[step], demo.place_ids[step]
    picked, turn = names.get(pick_id, "an object"), _turn_deg(action)
    by = f"{abs(turn)}° to the {'left' if turn > 0 else 'right'}"
    if demo.end_effector == "spatula":
        words = f"sweep {picked}"
    elif place_id == pick_id in names:
        words = f"turn {picked} {by}"
    else:  # an id that names no object means the table, or that nobody knows
        words = f"move {picked}" + (f" to {names[place_id]}" if place_id in names else "")
        words += f", turned {by}" if abs(turn) >= _LEAST_TURN_DEG else ""
    return f"{step + 1}: {words}"


def _turn_deg(action: Action) -> int:
    """By how much an action turns what it carries, in whole degrees; to the left seen from above."""
    yaws = [2 * math.atan2(q[2], q[3]) for q in (action.pose0_rotation, action.pose1_rotation)]
    return round(math.degrees(math.remainder(yaws[1] - yaws[0], math.tau)))
