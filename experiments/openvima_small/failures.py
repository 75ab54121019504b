"""Figure of failed episodes: prompt, first picture with the actions that the policy took, and why it failed.

    python experiments/openvima_small/failures.py EVALUATION --out failures.png

EVALUATION is a folder of `openvima evaluate`; nothing is executed, the recorded actions are drawn. Each task
and level shows its first failed episodes, those that fail most often first. White arrows lead from pick to
place, numbered by step; green rings are objects that had to be moved, green crosses where to.
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.atomic_io import atomic_write
from openvima.env import EnvConfig
from openvima.env.tabletop import TabletopEnv
from openvima.errors import OpenVimaError
from openvima.evaluation.actions import action_arrays, read_actions
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.render import FRONT, project
from openvima.scene import AtPose
from openvima.video.prompt_strip import draw_prompt_strip, font
from openvima.video.recorder import SceneRenderer

OUT = Path("docs/images/openvima_small_failures.png")
MAX_PANELS = 8
COLUMNS = 2
ENLARGE = 4  # of the benchmark's front view; scaled down to the width of a panel
WIDTH, GAP, TITLE_PX, LINE_PX = 640, 16, 34, 26
INK, MUTED, PAPER, EDGE, GOOD = "#1f2933", "#5b6472", "#ffffff", "#d0d5dc", "#12b76a"
_TOP_PX = 60  # of the picture, where no object is
_SAME_PLACE_PX = 14.0  # nearer ends are those of a rotation, nearer starts share their numbers


@dataclass(frozen=True, slots=True)
class Failure:
    """A failed episode with its actions, shape (steps, 12)."""

    row: Row
    outcome: EpisodeOutcome
    actions: np.ndarray

    @property
    def title(self) -> str:
        """Task, level, and how often the task fails there."""
        failed = self.row.episodes - self.row.successes
        return f"{self.row.task}, {self.row.level}: {failed} of {self.row.episodes} failed"

    @property
    def reason(self) -> str:
        """Why the episode failed, and its seed."""
        return f"{self.outcome.reason} (seed {self.outcome.seed})"


def failures(folder: Path, *, per_task: int = 1) -> list[Failure]:
    """Return the first failed episodes of each task and level, of the weakest first.

    Raises:
        DatasetError: Results or actions are missing or damaged.
    """
    results = Results.read(folder)
    actions, _ = read_actions(folder, results.rows)
    found = []
    for index, row in sorted(enumerate(results.rows), key=lambda item: item[1].rate):
        failed = [
            k for k, outcome in enumerate(row.outcomes) if not outcome.success and len(actions[index][k])
        ]
        if not row.ablation:
            found += [Failure(row, row.outcomes[k], actions[index][k]) for k in failed[:per_task]]
    return found


def draw_failures(folder: Path, out: Path, *, per_task: int = 1, most: int = MAX_PANELS) -> Path | None:
    """Draw failed episodes of an evaluation.

    Args:
        folder: Folder of the evaluation, with its actions.
        out: The PNG file.
        per_task: Episodes of a task and level.
        most: Episodes in all.

    Returns:
        The file; None if no episode failed.
    """
    chosen = failures(folder, per_task=per_task)[:most]
    if not chosen:
        return None
    config = EnvConfig.from_record(Results.read(folder).config)
    panels = [_panel(failure, config) for failure in chosen]
    rows = [panels[k : k + COLUMNS] for k in range(0, len(panels), COLUMNS)]
    heights = [max(panel.height for panel in row) for row in rows]
    size = (COLUMNS * WIDTH + (COLUMNS - 1) * GAP, sum(heights) + GAP * (len(rows) - 1))
    whole, top = Image.new("RGB", size, PAPER), 0
    for row, height in zip(rows, heights, strict=True):
        for column, panel in enumerate(row):
            whole.paste(panel, (column * (WIDTH + GAP), top))
        top += height + GAP
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(out) as file:
        whole.quantize(256, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
    return out


def _panel(failure: Failure, config: EnvConfig) -> Image.Image:
    """Draw title, prompt, first picture with actions, and reason, one below the other."""
    env = config.make(failure.row.task, failure.row.level, domain="eval")
    env.reset(seed=failure.outcome.seed)
    strip = draw_prompt_strip(env.prompt, width=WIDTH, image_height=56, font_size=20)
    picture = _first_picture(env, failure.actions)
    reason = _wrapped(failure.reason, WIDTH - 20)
    height = TITLE_PX + len(strip) + picture.height + LINE_PX * len(reason) + 8
    panel = Image.new("RGB", (WIDTH, height), PAPER)
    draw = ImageDraw.Draw(panel)
    draw.text((10, TITLE_PX // 2), failure.title, font=font(18, bold=True), fill=INK, anchor="lm")
    panel.paste(Image.fromarray(strip), (0, TITLE_PX))
    panel.paste(picture, (0, TITLE_PX + len(strip)))
    top = TITLE_PX + len(strip) + picture.height + LINE_PX // 2 + 4
    for line in reason:
        draw.text((10, top), line, font=font(17), fill=MUTED, anchor="lm")
        top += LINE_PX
    draw.rectangle((0, 0, WIDTH - 1, height - 1), outline=EDGE)
    return panel


def _first_picture(env: TabletopEnv, actions: np.ndarray) -> Image.Image:
    pixels = SceneRenderer(env, ENLARGE).draw(env.scene, None)
    picture = Image.fromarray(pixels).resize(
        (WIDTH, WIDTH * FRONT.height // FRONT.width), Image.Resampling.BOX
    )
    draw = ImageDraw.Draw(picture)
    starts: dict[tuple[float, float], list[int]] = {}
    placements = {placement.id: placement for placement in env.scene.placements}
    for goal in env.episode.problem.goals:
        if isinstance(goal, AtPose):
            _draw_ring(draw, _pixel(placements[goal.object_id].pose.position))
            _draw_cross(draw, _pixel(goal.target.position))
    for number, step in enumerate(actions, 1):
        parts = action_arrays(step)
        start, end = (_pixel(parts[f"{pose}_position"]) for pose in ("pose0", "pose1"))
        _draw_arrow(draw, start, end)
        near = next((other for other in starts if math.dist(start, other) < _SAME_PLACE_PX), start)
        starts.setdefault(near, []).append(number)
    for start, numbers in starts.items():
        _draw_numbers(draw, start, ", ".join(map(str, numbers)))
    return picture.crop((0, _TOP_PX, WIDTH, picture.height))


def _pixel(position: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Project a point of the table to the picture."""
    column, row = WIDTH / FRONT.width * project(np.array([position[0], position[1], 0.01]), FRONT)
    return float(column), float(row)


def _draw_ring(draw: ImageDraw.ImageDraw, at: tuple[float, float]) -> None:
    box = (at[0] - 26, at[1] - 26, at[0] + 26, at[1] + 26)
    draw.ellipse(box, outline=GOOD, width=4)


def _draw_cross(draw: ImageDraw.ImageDraw, at: tuple[float, float]) -> None:
    for sign in (-9, 9):
        draw.line((at[0] - 9, at[1] - sign, at[0] + 9, at[1] + sign), fill=GOOD, width=4)


def _draw_arrow(draw: ImageDraw.ImageDraw, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Draw a white arrow with a dark border; none where the object is only rotated."""
    if math.dist(start, end) < _SAME_PLACE_PX:
        return
    tip = np.array(end)
    forward = (tip - start) / np.linalg.norm(tip - start)
    side, neck = np.array([-forward[1], forward[0]]), tip - 15 * forward
    for colour, border in ((INK, 2), (PAPER, 0)):
        draw.line((*start, *neck), fill=colour, width=4 + 2 * border)
        wide = 8 + 1.5 * border
        head = [tip + 2 * border * forward, neck - border * forward + wide * side]
        head.append(neck - border * forward - wide * side)
        draw.polygon([(float(x), float(y)) for x, y in head], fill=colour)


def _draw_numbers(draw: ImageDraw.ImageDraw, at: tuple[float, float], numbers: str) -> None:
    wide = max(12.0, font(17, bold=True).getlength(numbers) / 2 + 6)
    box = (at[0] - wide, at[1] - 12, at[0] + wide, at[1] + 12)
    draw.rounded_rectangle(box, 12, fill=PAPER, outline=INK, width=2)
    draw.text(at, numbers, font=font(17, bold=True), fill=INK, anchor="mm")


def _wrapped(text: str, width: int) -> list[str]:
    typeface, lines = font(17), [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        lines = [*lines[:-1], longer] if typeface.getlength(longer) <= width else [*lines, word]
    return lines


def main() -> None:
    """Draw the figure."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("evaluation", type=Path, help="folder of an evaluation")
    parser.add_argument("--per-task", type=int, default=1, help="episodes of each task and level")
    parser.add_argument("--most", type=int, default=MAX_PANELS, help="episodes in all")
    parser.add_argument("--out", type=Path, default=OUT, help="the PNG file")
    given = parser.parse_args()
    try:
        out = draw_failures(given.evaluation, given.out, per_task=given.per_task, most=given.most)
    except OpenVimaError as error:
        parser.error(str(error))
    print(out or "no episode failed")


if __name__ == "__main__":
    main()
