"""`sweep_without_exceeding`: sweep some of the small blocks into a U-shaped area, but not over a line in it.

Scene:    one to three blocks to sweep, as many of another texture, the area open towards the blocks, a line.
Prompt:   "Sweep two {swept_obj} into {bounds} without exceeding {constraint}."
Success:  exactly the asked number lies between the line and the mouth of the area, while no such block ever
          touched the line and no other block is there. "Any" means one, "all" all of one texture.
Source:   VIMA paper, task list of the appendix, "Visual constraint satisfaction".
"""

import math

from openvima.catalog import object_spec
from openvima.scene import (
    InZone,
    NeverTouches,
    ObjectImage,
    Placement,
    Pose,
    Problem,
    Prompt,
    Zone,
    ZoneKeptClear,
)
from openvima.tasks.blocks import scattered_blocks
from openvima.tasks.options import check_difficulty
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

TEMPLATE = "Sweep {det} {swept_obj} into {bounds} without exceeding {constraint}."
MAGNIFICATION = 7  # of the small block in the prompt
SCALE = 1.35  # of bounds and line
AREA_X, AREA_Y = 0.41, 0.0  # m, centre of the area
LINE_RANGE = (0.25, 0.6)  # where the line may lie, as shares of the area's depth from its back
CORNERS = ((0.57, -0.22), (0.58, 0.03))  # m, lower corners of the squares in which blocks lie
SWEPT_SPREAD_M, DISTRACTOR_SPREAD_M = 0.18, 0.09
NUM_SWEPT_WEIGHTS = {"easy": (0.5, 0.25, 0.25), "medium": (0.25, 0.5, 0.25), "hard": (0.25, 0.25, 0.5)}
NUMBER_WORDS = ("one", "two", "three")
_FACING = -math.pi / 2  # the area opens to its own +y, which has to point to the world's +x


@register_task(
    "sweep_without_exceeding",
    family="constraint_satisfaction",
    template=TEMPLATE,
    end_effector="spatula",
    oracle_max_steps=8,
)
def sample(table: TableSampler, *, difficulty: str = "easy") -> Problem:
    """Sample one problem.

    Args:
        table: The table to lay.
        difficulty: "easy", "medium" or "hard": more and more often two or three blocks.
    """
    check_difficulty(difficulty)
    rng, pool = table.rng, table.pool
    num_swept = 1 + int(rng.choice(3, p=NUM_SWEPT_WEIGHTS[difficulty]))
    swept_texture = table.choose(pool.dragged_textures)
    bounds_texture = table.choose(pool.base_textures)
    line_texture = table.choose([t for t in pool.base_textures if t != bounds_texture])
    corners = CORNERS if rng.random() < 0.5 else CORNERS[::-1]
    distractor_texture = table.choose([t for t in pool.dragged_textures if t != swept_texture])

    bounds = _add_flat(table, pool.base_objects[0], bounds_texture, AREA_X)
    depth, width = bounds.size[:2]
    low, high = (AREA_X + (share - 0.5) * depth for share in LINE_RANGE)
    line = _add_flat(table, "line", line_texture, rng.uniform(low, high))
    zone = _goal_zone(line.pose.x, line.size[1], depth=depth, width=width)

    def scatter(texture: str, corner: tuple[float, float], spread_m: float) -> list[Placement]:
        return scattered_blocks(
            table, texture, corner=corner, spread_m=spread_m, count=num_swept, outside=zone
        )

    swept = scatter(swept_texture, corners[0], SWEPT_SPREAD_M)
    distractors = scatter(distractor_texture, corners[1], DISTRACTOR_SPREAD_M)
    words = ("any", *NUMBER_WORDS[:num_swept], "all")
    word = table.choose(words)
    num_required = {"any": 1, "all": num_swept}.get(word) or words.index(word)
    ids = tuple(block.id for block in swept)
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(
            TEMPLATE,
            det=word,
            swept_obj=ObjectImage(swept[0], magnification=MAGNIFICATION),
            bounds=ObjectImage(bounds),
            constraint=ObjectImage(line),
        ),
        goals=tuple(InZone(object_id, zone, relative_to=line.id) for object_id in ids),
        constraints=(
            NeverTouches(ids, Zone(line.pose.x, AREA_Y, line.size[1], line.size[0]), "line"),
            ZoneKeptClear(tuple(block.id for block in distractors), zone),
        ),
        num_required=num_required,
    )


def _add_flat(table: TableSampler, object_name: str, texture: str, x: float) -> Placement:
    """Lay the area or the line across the table's middle, its length along y."""
    size_x, size_y, size_z = object_spec(object_name).size_min
    size_y = size_y * SCALE if object_name != "line" else size_y  # the line gets longer, not wider
    size = (size_x * SCALE, size_y, size_z)
    return table.add(object_name, texture, size=size, pose=Pose.planar(x, AREA_Y, _FACING), fixed=True)


def _goal_zone(line_x: float, line_width: float, *, depth: float, width: float) -> Zone:
    """Return the part of the area in front of the line.

    The benchmark's zone lies 15 mm nearer to the blocks than the drawn area; published results depend on it.
    """
    back, mouth = line_x + line_width / 2, AREA_X + depth / 2
    return Zone((back + mouth) / 2 + 0.015, AREA_Y, mouth - back, width)
