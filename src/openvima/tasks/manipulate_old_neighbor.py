"""`manipulate_old_neighbor`: put an object into the base, then its former neighbour.

Scene:    a grid of distinct objects with some empty cells, and a base to its right.
Prompt:   "First put {dragged_obj} into {base_obj} then put the object that was previously at its north into
          the same {base_obj}." North is away from the viewer, towards the robot; east is to the right.
Success:  object, then neighbour, within 0.1 m of the base's origin, while no other object is as near to it or
          to one of them.
Source:   VIMA paper, task list of the appendix, "Visual memory".
"""

from typing import Annotated

from openvima.scene import (
    AtPose,
    DistractorsApart,
    InOrder,
    ObjectImage,
    Placement,
    Pose,
    Problem,
    Prompt,
    Tolerance,
)
from openvima.tasks.options import Difficulty
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler, grid_point

TEMPLATE = (
    "First put {dragged_obj} into {base_obj} then put the object that was previously at its {direction} "
    "into the same {base_obj}."
)
TOLERANCE = Tolerance(position_m=0.1)
NEIGHBOURS = {
    "north": (-1, 0),
    "south": (1, 0),
    "west": (0, -1),
    "east": (0, 1),
}  # steps along x, y
NUM_ROWS = 3
NUM_MOVED = 2
NUM_COLUMNS = {"easy": 2, "medium": 3, "hard": 4}
NUM_EMPTY = {"easy": 1, "medium": 3, "hard": 4}
MAX_DISTRACTORS = NUM_ROWS * NUM_COLUMNS["hard"] - NUM_MOVED


@register_task("manipulate_old_neighbor", family="visual_reasoning", template=TEMPLATE, oracle_max_steps=4)
def sample(
    table: TableSampler,
    *,
    num_distractors: Annotated[int | None, range(MAX_DISTRACTORS + 1)] = None,
    difficulty: Difficulty = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Objects besides the two to move, 0 … 10; by default those of the difficulty. Columns
            are added as needed.
        difficulty: "easy", "medium" or "hard": 2, 3 or 4 columns with 1, 3 or 4 empty cells.
    """
    pool, num_columns = table.pool, NUM_COLUMNS[difficulty]
    if num_distractors is None:
        num_distractors = NUM_ROWS * num_columns - NUM_MOVED - NUM_EMPTY[difficulty]
    num_columns = max(num_columns, -(-(num_distractors + NUM_MOVED) // NUM_ROWS))
    cells = [(row, column) for row in range(NUM_ROWS) for column in range(num_columns)]
    dragged_cell = table.choose(cells)
    direction, neighbour_cell = _choose_neighbour(table, dragged_cell, cells)
    others = [cell for cell in cells if cell not in (dragged_cell, neighbour_cell)]
    empty_cells = table.distinct(others, len(others) - num_distractors)

    placed: dict[tuple[int, int], Placement] = {}
    appearances = table.distinct(table.appearances(), len(cells))
    for cell, appearance in zip(cells, appearances, strict=True):
        if cell not in empty_cells:
            placed[cell] = table.add(*appearance, pose=_cell_centre(cell, num_columns), fixed=False)

    base = table.add(
        table.choose(pool.base_objects),
        table.choose(pool.base_textures),
        pose=_cell_centre((1, num_columns), num_columns),
    )
    dragged, neighbour = placed.pop(dragged_cell), placed.pop(neighbour_cell)
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(
            TEMPLATE, dragged_obj=ObjectImage(dragged), base_obj=ObjectImage(base), direction=direction
        ),
        goals=tuple(AtPose.into(p, base, TOLERANCE) for p in (dragged, neighbour)),
        constraints=(InOrder((1,)), DistractorsApart.of(placed.values())),
    )


def _choose_neighbour(
    table: TableSampler, cell: tuple[int, int], cells: list[tuple[int, int]]
) -> tuple[str, tuple[int, int]]:
    """Draw a direction with a neighbouring cell, and that cell."""
    row, column = cell
    found = {name: (row + down, column + right) for name, (down, right) in NEIGHBOURS.items()}
    return table.choose([(name, there) for name, there in found.items() if there in cells])


def _cell_centre(cell: tuple[int, int], num_columns: int) -> Pose:
    """Return the centre of a cell; the base is in the column after the last one."""
    row, column = cell
    return grid_point(row + 1, NUM_ROWS + 1, column + 1, num_columns + 2)
