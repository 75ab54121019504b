"""`manipulate_old_neighbor`: put an object into the base, then its former neighbour.

Scene:    a grid of distinct objects with some empty cells, and a base to its right.
Prompt:   "First put {dragged_obj} into {base_obj} then put the object that was previously at its north into
          the same {base_obj}." North is away from the viewer, towards the robot; east is to the right.
Success:  object, then neighbour, within 0.1 m of the base's origin, while no other object is as near to it or
          to one of them.
Source:   VIMA paper, task list of the appendix, "Visual memory".
"""

from openvima.scene import (
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
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
from openvima.tasks.options import check_difficulty, check_num_distractors
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

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


@register_task("manipulate_old_neighbor", family="visual_reasoning", template=TEMPLATE, oracle_max_steps=4)
def sample(table: TableSampler, *, num_distractors: int | None = None, difficulty: str = "easy") -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Objects besides the two to move, 0 … 10; by default those of the difficulty. Columns
            are added as needed.
        difficulty: "easy", "medium" or "hard": 2, 3 or 4 columns with 1, 3 or 4 empty cells.
    """
    check_difficulty(difficulty)
    pool, num_columns = table.pool, NUM_COLUMNS[difficulty]
    if num_distractors is None:
        num_distractors = NUM_ROWS * num_columns - NUM_MOVED - NUM_EMPTY[difficulty]
    check_num_distractors(num_distractors, high=NUM_ROWS * max(NUM_COLUMNS.values()) - NUM_MOVED)
    num_columns = max(num_columns, -(-(num_distractors + NUM_MOVED) // NUM_ROWS))
    cells = [(row, column) for row in range(NUM_ROWS) for column in range(num_columns)]
    dragged_cell = table.choose(cells)
    direction, neighbour_cell = _choose_neighbour(table, dragged_cell, cells)
    others = [cell for cell in cells if cell not in (dragged_cell, neighbour_cell)]
    chosen = table.rng.choice(len(others), size=len(others) - num_distractors, replace=False)
    empty_cells = {others[index] for index in chosen}

    appearances = table.appearances()
    drawn = table.rng.choice(len(appearances), size=len(cells), replace=False)
    placed: dict[tuple[int, int], Placement] = {}
    for cell, index in zip(cells, drawn, strict=True):
        if cell not in empty_cells:
            name, texture = appearances[index]
            pose = _cell_centre(cell, num_columns)
            placed[cell] = table.add(name, texture, size=table.sample_size(name), pose=pose, fixed=False)

    base_object, base_texture = table.choose(pool.base_objects), table.choose(pool.base_textures)
    base = table.add(
        base_object,
        base_texture,
        size=table.sample_size(base_object),
        pose=_cell_centre((1, num_columns), num_columns),
    )
    dragged, neighbour = placed.pop(dragged_cell), placed.pop(neighbour_cell)
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(
            TEMPLATE, dragged_obj=ObjectImage(dragged), base_obj=ObjectImage(base), direction=direction
        ),
        goals=tuple(AtPose(p.id, base.pose, TOLERANCE, relative_to=base.id) for p in (dragged, neighbour)),
        constraints=(InOrder((1,)), DistractorsApart(tuple(p.id for p in placed.values()))),
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
    (low_x, low_y), (high_x, high_y) = WORKSPACE_LOW, WORKSPACE_HIGH
    row, column = cell
    x = low_x + (row + 1) * (high_x - low_x) / (NUM_ROWS + 1)
    y = low_y + (column + 1) * (high_y - low_y) / (num_columns + 2)
    return Pose.planar(x, y)
