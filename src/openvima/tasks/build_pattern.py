"""`build_pattern`: move six to eight objects to the pattern of a goal image, and clear what is in the way.

Scene:    objects in cells of a grid of three by six, away from the cells of the pattern; one or two
          distractors, each in a cell of the pattern.
Prompt:   "Rearrange to this {scene}." As in `rearrange`, which has up to three objects.
Success:  each object was within 0.08 m of its target, and at the end no distractor is as near to an object or
          a target.
Source:   level L8 of openvima; not in the VIMA paper.
"""

import math
from collections.abc import Sequence
from typing import Annotated

from openvima.scene import (
    AtPose,
    DistractorsApart,
    Pose,
    Problem,
    Prompt,
    SceneImage,
    Tolerance,
)
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler, grid_point

TEMPLATE = "Rearrange to this {scene}."
TOLERANCE = Tolerance(position_m=0.08)  # half the distance of two cells
NUM_ROWS, NUM_COLUMNS = 3, 6
PATTERNS = (
    "XXX XXX ...",
    "XXXXXX ...... ......",
    "XXXX X..X ....",
    ".XX. X..X .XX.",
    "X... X... XXXX",
    "X.X XXX X.X",
    "XXX .X. XXX",
    "XXX X.. XXX",
    "XXX X.X XXX",
    "XXXX .... XXXX",
)
_SPARE_STEPS = 2


@register_task("build_pattern", family="visual_goal_reaching", template=TEMPLATE, oracle_max_steps=12)
def sample(table: TableSampler, *, num_distractors: Annotated[int, range(3)] = 1) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Objects in the way, 0 … 2.
    """
    target_cells = _shifted(table, table.choose(PATTERNS).split())
    cells = [(row, column) for row in range(NUM_ROWS) for column in range(NUM_COLUMNS)]
    free = table.shuffled([cell for cell in cells if cell not in target_cells])
    if len(free) < len(target_cells) + num_distractors:
        num_distractors = len(free) - len(target_cells)

    count = len(target_cells) + num_distractors
    drawn = table.distinct(table.appearances(), count)
    start_cells = [*free[: len(target_cells)], *table.distinct(target_cells, num_distractors)]
    placed = [
        table.add(name, texture, size=table.sample_size(name), pose=_in_cell(table, cell))
        for (name, texture), cell in zip(drawn, start_cells, strict=True)
    ]
    objects, distractors = placed[: len(target_cells)], placed[len(target_cells) :]
    targets = [
        p.at(Pose((pose.x, pose.y, p.pose.z), pose.quaternion))
        for p, pose in zip(objects, map(cell_centre, target_cells), strict=True)
    ]
    parking = [cell_centre(cell) for cell in free[len(target_cells) : count]]
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(TEMPLATE, scene=SceneImage.of(targets)),
        goals=tuple(AtPose(target.id, target.pose, TOLERANCE) for target in targets),
        constraints=(DistractorsApart.of(distractors, at_end=True),),
        prerequisites=tuple(
            AtPose(p.id, pose, TOLERANCE) for p, pose in zip(distractors, parking, strict=True)
        ),
        oracle_max_steps=count + _SPARE_STEPS,
    )


def _shifted(table: TableSampler, rows: Sequence[str]) -> list[tuple[int, int]]:
    """Draw where along the table a pattern is; return its cells, row by row."""
    shift = int(table.rng.integers(NUM_COLUMNS - len(rows[0]) + 1))
    return [(r, shift + c) for r, row in enumerate(rows) for c, mark in enumerate(row) if mark == "X"]


def cell_centre(cell: tuple[int, int]) -> Pose:
    """Return the centre of a cell of the table, unrotated."""
    row, column = cell
    return grid_point(row + 0.5, NUM_ROWS, column + 0.5, NUM_COLUMNS)


def _in_cell(table: TableSampler, cell: tuple[int, int]) -> Pose:
    """Turn an object in its cell by a multiple of 90 degrees, so that it stays within."""
    return cell_centre(cell).rotated(int(table.rng.integers(4)) * math.pi / 2)
