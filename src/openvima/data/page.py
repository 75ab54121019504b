"""The data page: one self-contained HTML file without scripts."""

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

from openvima.atomic_io import atomic_write_file
from openvima.data.reader import Dataset
from openvima.data.records import Demonstration
from openvima.data.schema import IMAGE_SHAPE, VIEWS
from openvima.data.summary import Summary
from openvima.errors import AssetError, ConfigError, DatasetError
from openvima.html import render_page, require_extra
from openvima.multiprocess import Report
from openvima.render import channels_last
from openvima.render.camera import CAMERAS, View, project
from openvima.scene import BACKGROUND_ID, Action, PromptImage
from openvima.video.encoder import png

__all__ = ["write_page"]

MAX_SAMPLES = 50  # of each task; a page with more is too large for a browser


def write_page(summary: Summary, out: Path, *, num_samples: int = 3, report: Report | None = None) -> Path:
    """Write the page of a data set; equal data give equal bytes.

    Args:
        summary: Statistics of the data set.
        out: The HTML file to write.
        num_samples: Episodes of each task on the page, evenly spread.
        report: Called with episodes drawn, episodes to draw, and a note.

    Returns:
        The file.

    Raises:
        ConfigError: The number of samples is out of range.
        DatasetError: The data set is damaged.
    """
    if not 0 <= num_samples <= MAX_SAMPLES:
        raise ConfigError(f"samples is {num_samples}; it must lie within 0 … {MAX_SAMPLES}.")
    require_extra()
    counts, manifest = summary.manifest["counts"], summary.manifest
    tiles = {
        "episodes": f"{counts['episodes']:,}",
        "steps": f"{counts['steps']:,}",
        "files": f"{counts['shards']:,}",
        "size": _size(summary.file_bytes),
        "per episode": _size(summary.file_bytes / max(1, counts["episodes"])),
    }
    if summary.num_failed is not None:
        tiles["failed episodes kept apart"] = f"{summary.num_failed:,}"
    page = render_page(
        "dataset",
        counts=counts,
        manifest=manifest,
        tiles=tiles,
        tasks=summary.tasks,
        histograms=[histogram for histogram in summary.histograms if len(histogram.counts) > 1],
        episodes=_make_cards(summary, num_samples, report or (lambda done, total, note: None)),
        settings=json.dumps(manifest["config"], indent=2, ensure_ascii=False),
        caches={name: _size(size) for name, size in summary.object_caches.items()},
    )
    return atomic_write_file(out, page)


def _make_cards(summary: Summary, num_samples: int, report: Report) -> dict[str, list[object]]:
    """Values of the template `episode` for some episodes of each task, or why one cannot be shown."""
    if not num_samples:
        return {}
    dataset = Dataset(summary.folder)
    task_of = np.array(dataset.index.column("task").to_pylist(), dtype=str)
    chosen = {task.task: _spread(np.flatnonzero(task_of == task.task), num_samples) for task in summary.tasks}
    total, done = sum(map(len, chosen.values())), 0
    cards: dict[str, list[object]] = {}
    for task, episodes in chosen.items():
        for episode_index in episodes:
            cards.setdefault(task, []).append(_make_card(dataset, episode_index))
            done += 1
            report(done, total, task)
    return cards


def _spread(numbers: np.ndarray, count: int) -> list[int]:
    places = np.arange(min(count, len(numbers))) * len(numbers) // max(1, min(count, len(numbers)))
    return numbers[places].tolist()


def _make_card(dataset: Dataset, episode_index: int) -> dict[str, object] | str:
    try:
        return make_episode_card(dataset[episode_index])
    except (AssetError, DatasetError) as error:  # stored without images, which cannot be rerendered here
        if dataset.shard(dataset.locate(episode_index)[0]).info.images:
            raise
        return str(error)


def _size(num_bytes: float) -> str:
    for unit in ("B", "kB", "MB"):
        if num_bytes < 1000:
            return f"{num_bytes:.3g} {unit}"
        num_bytes /= 1000
    return f"{num_bytes:,.1f} GB"


_GAP = 2  # pixels between the two views
_MARGIN = 3  # pixels around an object in the prompt
_RING = 4.5  # radius in pixels
_HEAD = 7.0  # length of the arrow's head in pixels
_LEAST_TURN_DEG = 1


def make_episode_card(demo: Demonstration) -> dict[str, object]:
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
        "frames": [_make_frame(demo, step) for step in range(demo.num_steps + 1)],
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


def _make_frame(demo: Demonstration, step: int) -> dict[str, object]:
    """Observation of both cameras before a step, or at the end, with the action that follows."""
    height, width = IMAGE_SHAPE
    image = np.full((2 * height + _GAP, width, 3), 255, np.uint8)
    for index, view in enumerate(VIEWS):
        top = index * (height + _GAP)
        image[top : top + height] = channels_last(demo.rgb[view][step])
    arrows = [_draw_arrow(action, view) for action in demo.actions[step : step + 1] for view in VIEWS]
    return {"caption": _caption(demo, step), "png": _png(image), "arrows": arrows}


def _draw_arrow(action: Action, view: View) -> dict[str, object]:
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
    path = _draw_path([start + _RING * forward, end]) + _draw_path([wings[0], end, wings[1]])
    return {**ring, "path": path}


def _draw_path(points: list[np.ndarray]) -> str:
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
