"""What the two sweeping tasks share: who takes part, area and line, and the problem made of them."""

import math
from dataclasses import dataclass

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
from openvima.tasks.table import TableSampler

Corner = tuple[float, float]

MAGNIFICATION = 7  # of the small block in the prompt
CORNERS: tuple[Corner, Corner] = (
    (0.57, -0.22),
    (0.58, 0.03),
)  # m, lower ones of the squares that hold blocks
SWEPT_SPREAD_M = 0.18
NUM_SWEPT_WEIGHTS = {"easy": (0.5, 0.25, 0.25), "medium": (0.25, 0.5, 0.25), "hard": (0.25, 0.25, 0.5)}
NUMBER_WORDS = ("one", "two", "three")
_FACING = -math.pi / 2  # the area opens to its own +y, which has to point to the world's +x


@dataclass(frozen=True, slots=True)
class Cast:
    """Who takes part.

    Args:
        num_swept: Number of blocks to sweep; there are as many distractors.
        swept_texture, bounds_texture, line_texture, distractor_texture: What they look like.
        swept_corner, distractor_corner: Lower corners, x and y in metres, of where the blocks lie.
    """

    num_swept: int
    swept_texture: str
    bounds_texture: str
    line_texture: str
    distractor_texture: str
    swept_corner: Corner
    distractor_corner: Corner


def draw_cast(table: TableSampler, difficulty: str) -> Cast:
    """Draw how many blocks there are, what everything looks like and which blocks lie on which side.

    Args:
        table: The table to lay.
        difficulty: "easy", "medium" or "hard": more and more often two or three blocks.

    Raises:
        ConfigError: There is no such difficulty.
    """
    check_difficulty(difficulty)
    rng, pool = table.rng, table.pool
    num_swept = 1 + int(rng.choice(3, p=NUM_SWEPT_WEIGHTS[difficulty]))
    swept = table.choose(pool.dragged_textures)
    bounds = table.choose(pool.base_textures)
    line = table.choose([texture for texture in pool.base_textures if texture != bounds])
    corners = CORNERS if rng.random() < 0.5 else CORNERS[::-1]
    distractor = table.choose([texture for texture in pool.dragged_textures if texture != swept])
    return Cast(num_swept, swept, bounds, line, distractor, *corners)


def lay_flat(
    table: TableSampler, object_name: str, texture: str, *, x: float, scale: tuple[float, float]
) -> Placement:
    """Lay area or line across the table's middle, so that the area opens away from the robot.

    Args:
        table: The table to lay.
        object_name: Name in the catalogue.
        texture: Name in the catalogue.
        x: Where its centre goes, in metres.
        scale: Factors on its first two nominal sizes: depth and width of the area, length and width of the
            line.
    """
    size_x, size_y, size_z = object_spec(object_name).size_min
    size = (size_x * scale[0], size_y * scale[1], size_z)
    return table.add(object_name, texture, size=size, pose=Pose.planar(x, 0.0, _FACING), fixed=True)


def sweep_problem(
    table: TableSampler,
    cast: Cast,
    *,
    template: str,
    bounds: Placement,
    line: Placement,
    zone: Zone,
    zone_marker: Placement,
    distractor_spread_m: float,
) -> Problem:
    """Scatter the blocks, draw how many of them are to be swept, and put the problem together.

    Args:
        table: The table, area and line on it.
        cast: Who takes part.
        template: The prompt with its slots.
        bounds: The area.
        line: The line that no block to sweep may touch.
        zone: Where blocks have to go.
        zone_marker: `bounds` or `line`, whichever the zone moves with.
        distractor_spread_m: Side of the square in which the distractors lie.

    Raises:
        SamplingError: The blocks found no place.
    """

    def scatter(texture: str, corner: Corner, spread_m: float) -> list[Placement]:
        return scattered_blocks(
            table, texture, corner=corner, spread_m=spread_m, count=cast.num_swept, outside=zone
        )

    swept = scatter(cast.swept_texture, cast.swept_corner, SWEPT_SPREAD_M)
    distractors = scatter(cast.distractor_texture, cast.distractor_corner, distractor_spread_m)
    words = ("any", *NUMBER_WORDS[: cast.num_swept], "all")
    word = table.choose(words)
    ids = tuple(block.id for block in swept)
    forbidden = Zone(line.pose.x, line.pose.y, line.size[1], line.size[0])
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(
            template,
            det=word,
            swept_obj=ObjectImage(swept[0], magnification=MAGNIFICATION),
            bounds=ObjectImage(bounds),
            constraint=ObjectImage(line),
        ),
        goals=tuple(InZone(object_id, zone, relative_to=zone_marker.id) for object_id in ids),
        constraints=(
            NeverTouches(ids, forbidden, "line"),
            ZoneKeptClear(tuple(block.id for block in distractors), zone),
        ),
        num_required={"any": 1, "all": cast.num_swept}.get(word) or words.index(word),
    )
