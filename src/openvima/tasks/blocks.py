"""Groups of small blocks for the sweeping tasks."""

import math

from openvima.catalog import Vector3
from openvima.errors import SamplingError
from openvima.scene import Placement, Pose, Zone, block_points, in_workspace
from openvima.tasks.footprints import Rectangle
from openvima.tasks.table import TableSampler

BLOCK = "small block"
_COMPAT_TRIES = 10
_TRIES = 500  # many, so that crowded groups of three are not underrepresented
_GAP_M = 0.001


def scattered_blocks(
    table: TableSampler,
    texture: str,
    *,
    corner: tuple[float, float],
    spread_m: float,
    count: int,
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
        poses = [_scattered_pose(table, corner, spread_m) for _ in range(count)]
        if not all(in_workspace(pose) for pose in poses):
            continue
        if table.compat or not (_overlap(poses, sizes) or _enter(poses, outside)):
            return [
                table.add(BLOCK, texture, size=size, pose=pose)
                for size, pose in zip(sizes, poses, strict=True)
            ]
    raise SamplingError(f"no valid poses for {count} small blocks near {corner}.")


def _scattered_pose(table: TableSampler, corner: tuple[float, float], spread_m: float) -> Pose:
    x, y, rotation = table.rng.random(3).tolist()
    return Pose.planar(corner[0] + spread_m * x, corner[1] + spread_m * y, 2 * math.pi * rotation)


def _overlap(poses: list[Pose], sizes: list[Vector3]) -> bool:
    footprints = [Rectangle.of_box(pose, size[0], size[1]) for pose, size in zip(poses, sizes, strict=True)]
    return any(a.comes_near(b, _GAP_M) for i, a in enumerate(footprints) for b in footprints[:i])


def _enter(poses: list[Pose], zone: Zone) -> bool:
    return any(zone.contains(point) for pose in poses for point in block_points(pose))
