"""Make tasks.png beside this file: the prompt and a solved scene of each task of the benchmark."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.catalog.partitions import PUBLISHED_TASKS
from openvima.env import TabletopEnv
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import OracleRolloutPolicy
from openvima.tasks import task_spec
from openvima.video.prompt_strip import INK, draw_prompt_strip, font
from openvima.video.recorder import SceneRenderer

COLUMNS, GAP, TITLE_HEIGHT = 3, 16, 30  # the last two in pixels
TRIES = 20  # seeds, until the oracle solves an episode


def first_solved(env: TabletopEnv) -> int:
    """Return the first seed that the oracle solves."""
    return next(seed for seed in range(TRIES) if play([env], [seed], OracleRolloutPolicy())[0].success)


def draw_panel(env: TabletopEnv, title: str, seed: int) -> Image.Image:
    """Title, prompt and the table after the episode."""
    play([env], [seed], OracleRolloutPolicy())
    scene = SceneRenderer(env, enlarge=2).draw(env.scene, joints=None)
    strip = draw_prompt_strip(env.prompt, width=scene.shape[1], image_height=56, font_size=16)
    head = Image.new("RGB", (scene.shape[1], TITLE_HEIGHT), (255, 255, 255))
    place = (10, TITLE_HEIGHT // 2)
    ImageDraw.Draw(head).text(place, title, font=font(17, bold=True), fill=INK, anchor="lm")
    return Image.fromarray(np.concatenate([np.asarray(head), strip, scene]))


def lay_out(panels: Sequence[Image.Image]) -> Image.Image:
    """Lay the panels in columns, each below the shortest one so far."""
    width = panels[0].width
    columns = min(COLUMNS, len(panels))
    ends = [GAP] * columns
    places = []
    for panel in panels:
        column = ends.index(min(ends))
        places.append((GAP + column * (width + GAP), ends[column]))
        ends[column] += panel.height + GAP
    sheet = Image.new("RGB", (GAP + columns * (width + GAP), max(ends)), (255, 255, 255))
    for panel, place in zip(panels, places, strict=True):
        sheet.paste(panel, place)
    return sheet


def encode_small(image: Image.Image) -> bytes:
    """Encode an image in 256 colours, a third of the size."""
    stream = BytesIO()
    image.quantize(256, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
    return stream.getvalue()


if __name__ == "__main__":
    panels = []
    for task in sorted(PUBLISHED_TASKS):
        env = TabletopEnv(task, level=task_spec(task).levels[0], domain="user")
        panels.append(draw_panel(env, task, first_solved(env)))
    Path(__file__).with_suffix(".png").write_bytes(encode_small(lay_out(panels)))
