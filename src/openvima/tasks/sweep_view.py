"""Blocks and lines of a scene, and collision checks of pushes, for planning sweeps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from openvima.errors import OracleError
from openvima.scene import InZone, NeverTouches, Pose, Problem, Scene, Zone
from openvima.scene.goal import object_of
from openvima.tasks.footprints import Rectangle
from openvima.tasks.pushes import Point, Push

_END_STEP_M = 0.015
_COLUMN_STEP_M = 0.05  # room for two blocks pushed along the same line
_END_EDGE_M = 0.03  # distance of ends from the zone's edge


@dataclass(frozen=True, slots=True)
class View:
    """Blocks and lines of a scene.

    Args:
        goals: The open goals, those with the block nearest to its zone first.
        footprints: Footprints of all blocks, by id.
        met_ids: Blocks of goals that are met.
        lines: Forbidden zones of the goals' blocks.
        overlap_m: Allowed overlap of a push with blocks swept already, in metres. Their goals stay met, and
            the spatula stops too early to push them onto a line.
    """

    goals: tuple[InZone, ...]
    footprints: dict[int, Rectangle]
    met_ids: frozenset[int]
    lines: tuple[Zone, ...]
    overlap_m: float = 0.0

    @staticmethod
    def of(goals: Sequence[InZone], scene: Scene, problem: Problem) -> "View":
        """Build the view of a scene with these open goals.

        Raises:
            OracleError: A goal's block is fixed to the table.
        """
        if fixed := [goal.object_id for goal in goals if scene[goal.object_id].fixed]:
            raise OracleError(f"{scene.describe(fixed[0])} is fixed to the table, so it cannot be swept.")

        def distance(goal: InZone) -> float:
            return scene[goal.object_id].pose.planar_distance(Pose.planar(goal.zone.x, goal.zone.y))

        blocks = [placement for placement in scene.placements if not placement.fixed]
        return View(
            goals=tuple(sorted(goals, key=distance)),
            footprints={b.id: Rectangle.of_box(b.pose, b.size[0], b.size[1]) for b in blocks},
            met_ids=frozenset(i for g in problem.goals if (i := object_of(g)) is not None)
            - {g.object_id for g in goals},
            lines=tuple(c.zone for c in problem.constraints if isinstance(c, NeverTouches)),
        )

    def place(self, goal: InZone) -> Point:
        """Centre of a goal's block."""
        footprint = self.footprints[goal.object_id]
        return footprint.x, footprint.y

    def after(self, goal: InZone, push: Push) -> "View":
        """Return the view after a push of the goal's block."""
        block = replace(self.footprints[goal.object_id], x=push.end[0], y=push.end[1], yaw_rad=push.yaw_rad)
        return replace(self, footprints=self.footprints | {goal.object_id: block})

    def only(self, goal: InZone) -> "View":
        """Return the same with no other goal."""
        return replace(self, goals=(goal,))

    def alone(self, goal: InZone) -> "View":
        """Return the same with no other goal and no other block."""
        return replace(self.only(goal), footprints={goal.object_id: self.footprints[goal.object_id]})

    def others(self, goal: InZone) -> Iterator[tuple[int, Rectangle]]:
        """Ids and footprints of all blocks but the goal's."""
        return ((i, block) for i, block in self.footprints.items() if i != goal.object_id)

    def cleared(self, goal: InZone, push: Push) -> Push | None:
        """Find a variant of a push of the goal's block without collisions, except for `overlap_m`.

        Returns:
            The push, possibly with the spatula off-centre; None if every variant collides.
        """
        if touches_line(push, self.lines):
            return None
        others = [
            (block, -self.overlap_m if object_id in self.met_ids else 0.0)
            for object_id, block in self.others(goal)
        ]
        block_area = push.block_area()
        if any(block_area.comes_near(other, margin) for other, margin in others):
            return None
        for shifted in push.variants():
            spatula, spatula_area = shifted.spatula_at_start(), shifted.spatula_area()
            if not any(spatula_area.comes_near(o, m) or spatula.meets_box_around(o) for o, m in others):
                return shifted
        return None


def touches_line(push: Push, lines: Sequence[Zone]) -> bool:
    """Whether a pushed block may touch a line."""
    if any(_crosses(push, line) for line in lines):
        return True
    area = push.block_area()
    return any(area.comes_near(Rectangle.of_zone(line)) for line in lines)


def _crosses(push: Push, line: Zone) -> bool:
    """Whether the block's centre crosses the middle of a line: cheaper to test than areas, and most do."""
    (x0, y0), (x1, y1) = push.start, push.end
    if (x0 < line.x) == (x1 < line.x):
        return False
    return abs(y0 + (line.x - x0) / (x1 - x0) * (y1 - y0) - line.y) < line.size_y / 2


def ends(zone: Zone, start: Point) -> Iterator[Point]:
    """Points in a zone to push a block to: the middle, then farther to the sides, then deeper and nearer.

    Args:
        zone: The zone.
        start: Position of the block; its own side comes first.
    """
    side = 1 if start[1] >= zone.y else -1
    num_steps = int((zone.size_y / 2 - _END_EDGE_M) / _END_STEP_M + 1e-9)
    shifts = (0.0, *(sign * _END_STEP_M * step for step in range(1, num_steps + 1) for sign in (side, -side)))
    has_columns = zone.size_x / 2 > _COLUMN_STEP_M + _END_EDGE_M
    columns = (0.0, -_COLUMN_STEP_M, _COLUMN_STEP_M) if has_columns else (0.0,)
    return ((zone.x + column, zone.y + shift) for column in columns for shift in shifts)
