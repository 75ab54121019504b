"""Shared parts of the sweeping tasks: area, line, groups of small blocks, and the problem."""

import itertools
import math
from collections.abc import Callable

from openvima.catalog import object_spec
from openvima.errors import SamplingError
from openvima.scene import (
    InZone,
    NeverTouches,
    ObjectImage,
    Placement,
    Point,
    Pose,
    Problem,
    Prompt,
    Zone,
    ZoneKeptClear,
    block_points,
    in_workspace,
)
from openvima.tasks.pushes import Rectangle
from openvima.tasks.table import TableSampler

BLOCK = "small block"
_COMPAT_TRIES = 10
_TRIES = 500  # many, so that crowded groups of three are not underrepresented
_GAP_M = 0.001


def scattered_blocks(
    table: TableSampler,
    texture: str,
    corner: Point,
    spread_m: float,
    count: int,
    *,
    outside: Zone,
) -> list[Placement]:
    """Scatter small blocks over a square by rejection sampling of the whole group.

    Blocks are in the workspace; without `compat` they neither overlap nor enter the goal's zone.

    Args:
        table: Sampler of the scene.
        texture: Texture of all of them.
        corner: x, y of the square's lower corner in metres.
        spread_m: Side of the square.
        count: Number of blocks.
        outside: The goal's zone.

    Returns:
        The blocks.

    Raises:
        SamplingError: No valid group was found.
    """
    sizes = [table.sample_size(BLOCK) for _ in range(count)]
    for _ in range(_COMPAT_TRIES if table.compat else _TRIES):
        drawn = [table.rng.random(3).tolist() for _ in range(count)]
        poses = [
            Pose.planar(corner[0] + spread_m * x, corner[1] + spread_m * y, 2 * math.pi * rotation)
            for x, y, rotation in drawn
        ]
        if not all(in_workspace(pose) for pose in poses):
            continue
        footprints = [
            Rectangle.of_box(pose, size[0], size[1]) for pose, size in zip(poses, sizes, strict=True)
        ]
        is_free = not any(
            one.comes_near(other, _GAP_M) for one, other in itertools.combinations(footprints, 2)
        ) and not any(outside.contains(point) for pose in poses for point in block_points(pose))
        if table.compat or is_free:
            return [
                table.add(BLOCK, texture, size=size, pose=pose)
                for size, pose in zip(sizes, poses, strict=True)
            ]
    raise SamplingError(f"no valid poses for {count} small blocks near {corner}.")


MAGNIFICATION = 7  # of the small block in the prompt
CORNERS: tuple[Point, Point] = ((0.57, -0.22), (0.58, 0.03))  # m, lower corners of the squares of blocks
SWEPT_SPREAD_M = 0.18
NUM_SWEPT_WEIGHTS = {"easy": (0.5, 0.25, 0.25), "medium": (0.25, 0.5, 0.25), "hard": (0.25, 0.25, 0.5)}
NUMBER_WORDS = ("one", "two", "three")
_FACING = -math.pi / 2  # rotates the area's open side, +y, to +x


def place_flat(
    table: TableSampler, object_name: str, texture: str, *, x: float, scale: tuple[float, float]
) -> Placement:
    """Place area or line across the table's middle; the area opens away from the robot.

    Args:
        table: Sampler of the scene.
        object_name: Name in the catalogue.
        texture: Name in the catalogue.
        x: Its centre in metres.
        scale: Factors on its first two nominal sizes: depth and width of the area, length and width of the
            line.
    """
    size_x, size_y, size_z = object_spec(object_name).size_min
    size = (size_x * scale[0], size_y * scale[1], size_z)
    return table.add(object_name, texture, size=size, pose=Pose.planar(x, 0.0, _FACING), fixed=True)


Layout = tuple[Placement, Placement, Zone, Placement]
"""Area and line, the goal of the blocks, and which of the two it is relative to."""


def sweep_problem(
    table: TableSampler,
    template: str,
    *,
    difficulty: str,
    num_distractors: int | None,
    lay_out: Callable[[str, str], Layout],
    distractor_spread_m: float,
) -> Problem:
    """Draw roles and textures, place area, line and blocks, and build the problem.

    Args:
        table: Sampler of the scene.
        template: The prompt with its slots.
        difficulty: "easy", "medium" or "hard": increasing probability of two or three blocks.
        num_distractors: Distractors, 0 … 6; None: as many as blocks to sweep.
        lay_out: Places area and line in two textures; no block to sweep may touch the line.
        distractor_spread_m: Side of the distractors' square.

    Raises:
        SamplingError: No valid group of blocks was found.
    """
    rng, pool = table.rng, table.pool
    num_swept = 1 + int(rng.choice(3, p=NUM_SWEPT_WEIGHTS[difficulty]))
    swept_texture = table.choose(pool.dragged_textures)
    bounds_texture = table.choose(pool.base_textures)
    line_texture = table.choose([texture for texture in pool.base_textures if texture != bounds_texture])
    swept_corner, distractor_corner = CORNERS if rng.random() < 0.5 else CORNERS[::-1]
    distractor_texture = table.choose([each for each in pool.dragged_textures if each != swept_texture])
    num_distractors = num_swept if num_distractors is None else num_distractors
    bounds, line, zone, zone_marker = lay_out(bounds_texture, line_texture)

    if num_distractors > len(NUMBER_WORDS):  # more than published find no place in a small square
        distractor_spread_m = SWEPT_SPREAD_M
    swept = scattered_blocks(table, swept_texture, swept_corner, SWEPT_SPREAD_M, num_swept, outside=zone)
    distractors = scattered_blocks(
        table, distractor_texture, distractor_corner, distractor_spread_m, num_distractors, outside=zone
    )
    words = ("any", *NUMBER_WORDS[:num_swept], "all")
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
        num_required={"any": 1, "all": num_swept}.get(word) or words.index(word),
    )
