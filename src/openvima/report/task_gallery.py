"""Task gallery: the prompt and a solved episode of every task."""

from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.atomic_io import atomic_write_file
from openvima.env import EnvConfig, TabletopEnv
from openvima.env.config import DEFAULT_ENV_CONFIG
from openvima.evaluation.recording import save_episode_image
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import OracleRolloutPolicy
from openvima.html import render_page, require_extra
from openvima.tasks import task_spec
from openvima.tasks.registry import tasks_of
from openvima.video.prompt_strip import INK, draw_prompt_strip, font
from openvima.video.recorder import SceneRenderer

SHEET_NAME = "contact_sheet.png"
PAGE_NAME = "index.html"
_COLUMNS, _GAP, _TITLE_HEIGHT = 3, 16, 30  # the last two in pixels
_TRIES = 20  # seeds, until the oracle solves an episode


def save_task_gallery(
    folder: Path,
    *,
    env_config: EnvConfig = DEFAULT_ENV_CONFIG,
    level: str | None = None,
    tasks: Sequence[str] = (),
    report: Callable[[int, int, str], None] | None = None,
) -> Path:
    """Write a page with a solved episode of each task, its images, and all of them on one sheet.

    Args:
        folder: Where `index.html`, one PNG a task and `contact_sheet.png` go.
        env_config: Settings of the environments.
        level: Show its tasks only; by default all, each at its first level.
        tasks: Names of tasks to show instead.
        report: Called with tasks done, tasks in all, and the task's name.

    Returns:
        The page.
    """
    require_extra()
    folder.mkdir(parents=True, exist_ok=True)
    specs = [task_spec(name) for name in tasks or tasks_of(level)]
    panels = []
    for number, spec in enumerate(specs):
        env = env_config.make(spec.name, level or spec.levels[0], domain="user")
        solved = _first_solved(env)
        save_episode_image(env, folder / f"{spec.name}.png", seed=solved)
        panels.append(_panel(env, spec.name, solved))
        if report is not None:
            report(number + 1, len(specs), spec.name)
    atomic_write_file(folder / SHEET_NAME, _small_png(_sheet(panels)))
    return atomic_write_file(folder / PAGE_NAME, render_page("tasks", tasks=specs))


def _first_solved(env: TabletopEnv) -> int:
    for candidate in range(_TRIES):
        (outcome,) = play([env], [candidate], OracleRolloutPolicy())
        if outcome.success:
            return candidate
    return 0


def _panel(env: TabletopEnv, title: str, seed: int) -> Image.Image:
    """Title, prompt and the table after the episode."""
    play([env], [seed], OracleRolloutPolicy())
    scene = SceneRenderer(env, enlarge=2).draw(env.scene, joints=None)
    strip = draw_prompt_strip(env.prompt, width=scene.shape[1], image_height=56, font_size=16)
    head = Image.new("RGB", (scene.shape[1], _TITLE_HEIGHT), (255, 255, 255))
    place = (10, _TITLE_HEIGHT // 2)
    ImageDraw.Draw(head).text(place, title, font=font(17, bold=True), fill=INK, anchor="lm")
    return Image.fromarray(np.concatenate([np.asarray(head), strip, scene]))


def _sheet(panels: Sequence[Image.Image]) -> Image.Image:
    """Lay the panels in columns, each below the shortest one so far."""
    width = panels[0].width
    columns = min(_COLUMNS, len(panels))
    ends = [_GAP] * columns
    places = []
    for panel in panels:
        column = ends.index(min(ends))
        places.append((_GAP + column * (width + _GAP), ends[column]))
        ends[column] += panel.height + _GAP
    sheet = Image.new("RGB", (_GAP + columns * (width + _GAP), max(ends)), (255, 255, 255))
    for panel, place in zip(panels, places, strict=True):
        sheet.paste(panel, place)
    return sheet


def _small_png(image: Image.Image) -> bytes:
    """Encode an image in 256 colours, a third of the size."""
    stream = BytesIO()
    image.quantize(256, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
    return stream.getvalue()
