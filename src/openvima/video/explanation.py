"""Explanations as images for people: what a policy considered, over the table as the top camera sees it.

Orange stands for the pick, blue for the place. The prompt's shading is drawn by `prompt_strip`.
"""

import math
import textwrap
from collections.abc import Iterator, Sequence

import numpy as np
from PIL import Image, ImageDraw

from openvima.catalog.geometry import Assets
from openvima.errors import echo
from openvima.render import TOP, channels_last, project, unproject
from openvima.render.rasteriser import Rasteriser
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Scene
from openvima.scene.explanation import Explanation, ObjectProbability, PlaceProbability
from openvima.video.prompt_strip import INK, MUTED, PAPER, Colour, font, percent

ENLARGE = 2
WIDTH, HEIGHT = TOP.width * ENLARGE, TOP.height * ENLARGE + 160  # pixels of a panel
PICK: Colour = (214, 96, 0)
PLACE: Colour = (0, 104, 201)
COLOURS: dict[str, Colour] = {"pick": PICK, "place": PLACE, "decoder": (104, 64, 160)}
HEAT_COLOURS = {"pose0": PICK, "pose1": PLACE}
LEAST_SHOWN = 0.01  # probability below which a label would say 0 or 1 %
_HOT = 0.02  # probability of a cell of the heat map that is drawn in full colour
_NUM_LINES, _LINE_CHARACTERS = 8, 62  # of words, in a panel
_KINDS = {
    "first step": "as at the start",
    "prompt": "as in the prompt",
    "grid": "free spot",
}


def draw_panel(scene: Scene, assets: Assets, explanation: Explanation | None) -> np.ndarray:
    """Draw what a policy considered in a scene.

    Args:
        scene: The scene before the action.
        assets: Asset pack of the objects.
        explanation: What it considered; None before the first decision.

    Returns:
        Shape (`HEIGHT`, `WIDTH`, 3), uint8: the table from above, below it the most probable choices.
    """
    image = Rasteriser(assets).scene(scene, views=("top",), enlarge=ENLARGE)["top"]
    panel = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    panel[: TOP.height * ENLARGE] = channels_last(image.rgb)
    if explanation is not None and explanation.bins and not explanation.objects:
        _tint_heat_maps(panel, explanation)
    elif explanation is not None:
        _tint_objects(panel, image.segm, explanation.objects)
    canvas = Image.fromarray(panel)
    draw = ImageDraw.Draw(canvas)
    if explanation is None:
        draw.text((12, HEIGHT - 96), "before the first decision", font=font(15), fill=MUTED, anchor="lm")
        return np.asarray(canvas)
    if explanation.words:
        _draw_action(draw, explanation)
        _draw_words(draw, explanation)
        return np.asarray(canvas)
    places = explanation.distinct_places()
    for place in reversed(places):
        _draw_place(draw, place)
    _draw_action(draw, explanation)
    _draw_labels(draw, explanation.objects, places)
    whose = "the decoder" if explanation.bins else "pick (upper row) and place"
    legend = f"below the prompt: attention of {whose}"
    draw.text((12, HEIGHT - 16), legend, font=font(13), fill=MUTED, anchor="lm")
    for number, (text, colour) in enumerate(_choices(explanation, places, scene)):
        at = (12, TOP.height * ENLARGE + 20 + 26 * number)
        draw.text(at, text, font=font(15, bold=True), fill=colour, anchor="lm")
    return np.asarray(canvas)


def _choices(
    explanation: Explanation, places: Sequence[PlaceProbability], scene: Scene
) -> Iterator[tuple[str, Colour]]:
    """Say what is most probable, each in its colour."""
    names = {placement.id: f"{placement.object}, {placement.texture}" for placement in scene.placements}
    if explanation.objects:
        best = max(explanation.objects, key=lambda each: each.probability)
        yield f"pick {percent(best.probability)}: {names.get(best.object_id, 'object')}", PICK
    if places:
        name = _name_of(places[0], explanation.objects, names)
        yield f"place {percent(places[0].probability)}: {name}", PLACE
    if len(explanation.yaw_rad):
        share, yaw_rad = max(zip(explanation.yaw_probabilities, explanation.yaw_rad, strict=True))
        angle = round(math.degrees(yaw_rad))
        direction = " clockwise" if angle < 0 else " counter-clockwise" if angle > 0 else ""
        yield f"rotation {percent(share)}: {abs(angle)}°{direction}", PLACE


def _draw_words(draw: ImageDraw.ImageDraw, explanation: Explanation) -> None:
    """Draw the points of an answer over the table, and below it the words, of long ones the end."""
    for pose, colour in HEAT_COLOURS.items():
        x, y = _pixel(explanation.action[f"{pose}_position"])
        for radius, ring in ((8, PAPER), (6, colour)):
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=ring, width=3)
    lines = [
        line
        for paragraph in explanation.words.splitlines()
        for line in textwrap.wrap(echo(paragraph, len(paragraph)), _LINE_CHARACTERS)
    ]
    cut = ["…", *lines[1 - _NUM_LINES :]] if len(lines) > _NUM_LINES else lines
    for number, line in enumerate(cut):
        y = TOP.height * ENLARGE + 14 + 19 * number
        draw.text((12, y), line, font=font(14), fill=INK, anchor="lm")


def attention_rows(explanation: Explanation) -> list[tuple[Colour, np.ndarray]]:
    """Return attention to the prompt as rows of colour and weights, for `draw_prompt_strip`."""
    end = None if explanation.bins else -1  # policies that point never attend to the end of the prompt
    return [(COLOURS.get(kind, INK), weights[:end]) for kind, weights in explanation.attention.items()]


def heat_opacity(probabilities: np.ndarray) -> np.ndarray:
    """Return how opaque cells of a heat map are drawn, from 0 to 0.8."""
    return 0.8 * np.sqrt(np.minimum(probabilities / _HOT, 1))


def _tint_objects(panel: np.ndarray, segm: np.ndarray, objects: Sequence[ObjectProbability]) -> None:
    """Colour objects by the probability of picking them, and outline them."""
    for each in sorted(objects, key=lambda each: each.probability):
        mask = segm == each.object_id
        if each.object_id < 0:
            mask = _box_mask(each, segm.shape)
        inner = mask.copy()
        for axis in (0, 1):
            inner &= np.roll(mask, 2, axis) & np.roll(mask, -2, axis)
        _blend(panel[: len(mask)], PICK, 0.75 * each.probability * mask)
        _blend(panel[: len(mask)], PICK, (each.probability >= LEAST_SHOWN) * (mask & ~inner))


def _box_mask(each: ObjectProbability, shape: tuple[int, ...]) -> np.ndarray:
    mask = np.zeros(shape, bool)
    if "top" in each.boxes:
        x, y, height, width = (ENLARGE * value for value in each.boxes["top"])
        mask[y - height // 2 : y + height // 2, x - width // 2 : x + width // 2] = True
    return mask


def _tint_heat_maps(panel: np.ndarray, explanation: Explanation) -> None:
    """Colour the table by the probabilities of both positions."""
    rows, columns = np.indices((TOP.height * ENLARGE, WIDTH))
    points = unproject(np.stack([columns, rows], -1) / ENLARGE, TOP)
    low, high = np.array(WORKSPACE_LOW), np.array(WORKSPACE_HIGH)
    is_inside = ((low <= points) & (points < high)).all(axis=-1)
    shares = (points[is_inside] - low) / (high - low)
    for pose, colour in HEAT_COLOURS.items():
        heat, opacity = explanation.heat_map(pose), np.zeros(rows.shape)
        x, y = (shares * heat.shape).astype(int).T
        opacity[is_inside] = heat_opacity(heat[x, y])
        _blend(panel[: len(rows)], colour, opacity)


def _blend(image: np.ndarray, colour: Colour, alpha: np.ndarray) -> None:
    weight = np.asarray(alpha, np.float64)[..., None]
    image[:] = np.rint(image * (1 - weight) + np.array(colour) * weight)


def _pixel(position: Sequence[float] | np.ndarray) -> tuple[float, float]:
    column, row = ENLARGE * project(np.array([float(position[0]), float(position[1]), 0.0]), TOP)
    return float(column), float(row)


def _draw_place(draw: ImageDraw.ImageDraw, place: PlaceProbability) -> None:
    x, y = _pixel(place.position)
    radius = 3 + 8 * math.sqrt(place.probability)
    shown = place.probability >= LEAST_SHOWN
    for grow, colour in ((2, (255, 255, 255)), (0, PLACE if shown else (150, 180, 210))):
        size = radius + grow
        if shown or not grow:
            draw.ellipse((x - size, y - size, x + size, y + size), outline=colour, width=3 if shown else 1)


def _draw_action(draw: ImageDraw.ImageDraw, explanation: Explanation) -> None:
    """Draw an arrow from pick to place, unless the object is only rotated."""
    start, end = (np.array(_pixel(explanation.action[f"{pose}_position"])) for pose in ("pose0", "pose1"))
    length = np.linalg.norm(end - start)
    if length < 24:
        return
    forward = (end - start) / length
    side, neck = np.array([-forward[1], forward[0]]), end - 14 * forward
    for colour, border in ((INK, 2), (PAPER, 0)):  # a white arrow with a dark border
        back, wide = neck - border * forward, (7 + 1.5 * border) * side
        head = np.array([end + 2 * border * forward, back + wide, back - wide])
        draw.line([*start, *neck], fill=colour, width=4 + 2 * border)
        draw.polygon(head.ravel().tolist(), fill=colour)


def _draw_labels(
    draw: ImageDraw.ImageDraw, objects: Sequence[ObjectProbability], places: Sequence[PlaceProbability]
) -> None:
    for each in objects:
        if each.probability >= LEAST_SHOWN and "top" in each.boxes:
            x, y, height, _ = (ENLARGE * value for value in each.boxes["top"])
            row = y - height / 2 - 2 if y - height / 2 > 20 else y + height / 2 + 20
            _label(draw, (x, row), each.probability, PICK, "md")
    for place in places:
        if place.probability >= LEAST_SHOWN:
            x, y = _pixel(place.position)
            row, anchor = (y + 13, "ma") if y < TOP.height * ENLARGE - 34 else (y - 13, "md")
            _label(draw, (x, row), place.probability, PLACE, anchor)


def _label(
    draw: ImageDraw.ImageDraw, at: tuple[float, float], probability: float, colour: Colour, anchor: str
) -> None:
    text = percent(probability)
    x = min(max(at[0], 26), WIDTH - 26)
    draw.text(
        (x, at[1]),
        text,
        font=font(16, bold=True),
        fill=colour,
        anchor=anchor,
        stroke_width=3,
        stroke_fill=PAPER,
    )


def _name_of(place: PlaceProbability, objects: Sequence[ObjectProbability], names: dict[int, str]) -> str:
    """Return what is at a place candidate, in words."""
    if place.kind != "in view":
        return _KINDS[place.kind]
    x, y = _pixel(place.position)
    near = [each for each in objects if "top" in each.boxes]
    if not near:
        return "object in view"
    nearest = min(near, key=lambda each: math.dist((x / ENLARGE, y / ENLARGE), each.boxes["top"][:2]))
    return names.get(nearest.object_id, "object in view")
