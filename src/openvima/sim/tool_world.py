"""The simulated world under low-level control: one command of 0.1 s at a time."""

import math
from dataclasses import replace

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.errors import ActionError
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Pose, Scene
from openvima.scene.action import CONTROL_HZ, HIGHEST_TIP_Z_M, ToolCommand, ToolPose
from openvima.sim import ur5
from openvima.sim.bodies import Bodies
from openvima.sim.model import FLOOR_Z_M, TICK_S
from openvima.sim.primitive_state import (
    STRIDE_TICKS,
    Monitor,
    PrimitiveState,
    RecordFrame,
    Settling,
    is_at_rest,
)
from openvima.sim.spatula import SWEEP_M_S, Spatula
from openvima.sim.world import SEPARATION_SPEED, HeldBody, body_under_probe, take_out

MAX_JOINT_SPEED = math.pi  # rad/s, of every joint, as in the UR5's data sheet
PRESS_WITHIN_M = 0.01  # the spatula is pressed to the table from at most this height above its lowest
_MARGIN_M = ur5.SPATULA_RUN_UP_M  # by which the tool leaves the workspace
_NUM_PARTS = 3  # of a command, in each of which contacts are tested; also the video frames of 1/30 s
_PART_TICKS = round(1 / (CONTROL_HZ * _NUM_PARTS * TICK_S))
_LOWEST_CUP_Z_M = FLOOR_Z_M + ur5.PROBE_BELOW_TIP_M
_TOUCH_M = 5e-4  # the cup grasps what is this near below it
_BISECTIONS = 12
_ROUNDING_M = 1e-9  # of the greatest height that the arm reaches
_PART_S = _PART_TICKS * TICK_S


class ToolWorld:
    """The table with its objects and the robot, whose tool follows commands.

    The cup and a held body stop at the first contact from above and do not enter bodies sideways; the
    spatula moves bodies only while it is pressed to the table. What was let go moves by physics while the
    commands go on. Deterministic, as `World`.

    Args:
        scene: The objects at the start. Those that hover or overlap settle before the first command.
        assets: Asset pack.

    Attributes:
        scene_at_rest: The scene when everything was last at rest, before the tool took hold.
        pose: Current pose of the tool.
    """

    def __init__(self, scene: Scene, assets: Assets) -> None:
        self.scene_at_rest = scene
        self._bodies = Bodies(scene, assets)
        self._is_settled = is_at_rest(self._bodies)
        self._joints = ur5.HOME
        tip = ur5.forward(ur5.HOME)
        self.pose = ToolPose(tip.x, tip.y, tip.z, 0.0)
        self._state: PrimitiveState | None = None  # since the tool last took hold, until all is at rest
        self._settling: Settling | None = None
        self._held: HeldBody | None = None
        self._stands_alone = False  # whether the held body did
        self._spatula: Spatula | None = None

    @property
    def scene(self) -> Scene:
        """The current scene, with a held body at the tool."""
        if self._state is None:
            return self.scene_at_rest
        return self._state.scene(self._held_at())

    @property
    def joints(self) -> np.ndarray:
        """Current joint angles of the arm, shape (6,), float64, radians."""
        return self._joints.copy()

    @property
    def holds(self) -> bool:
        """Whether the cup holds a body, or the spatula is pressed to the table."""
        return self._held is not None or self._spatula is not None

    @property
    def grasped(self) -> int | None:
        """Id of the body on the cup."""
        return None if self._held is None else self.scene_at_rest.placements[self._held.index].id

    @property
    def grasp(self) -> ToolPose | None:
        """Pose of the tool when it took hold of the body on the cup."""
        return None if self._held is None else self._held.grasp

    @property
    def is_moving(self) -> bool:
        """Whether bodies that were let go have not come to rest."""
        return self._settling is not None

    @property
    def is_down(self) -> bool:
        """Whether the cup or the held body touches what is below it."""
        return self.pose.z <= self._lowest_z(self.pose) + _TOUCH_M

    def command(
        self,
        command: ToolCommand,
        *,
        monitor: Monitor | None = None,
        record: RecordFrame | None = None,
    ) -> bool:
        """Follow a command for 0.1 s.

        The tool lets go before it moves and takes hold after.

        Args:
            command: The motion, and whether the tool is on.
            monitor: As in `World.execute`.
            record: Called with scene and joints, shape (6,), for every video frame, 30 a second.

        Returns:
            Whether a manipulation has ended: the tool has let go, and everything is at rest.
        """
        if not self._is_settled:
            state = self._new_state(monitor)
            state.settle(max_speed=SEPARATION_SPEED)
            self.scene_at_rest, self._is_settled = state.finish(), True
        if not command.tool:
            self._let_go()
        for _ in range(_NUM_PARTS):
            self._move(command)
            self._run_physics()
            if record is not None:
                record(self.scene, self.joints)
        if command.tool and not self.holds:
            self._take_hold(monitor)
        if self._state is None or self.holds or self.is_moving:
            return False
        self.scene_at_rest, self._state = self._state.finish(), None
        return True

    def _new_state(self, monitor: Monitor | None) -> PrimitiveState:
        return PrimitiveState(self.scene_at_rest, self._bodies, [self._joints], monitor)

    def _take_hold(self, monitor: Monitor | None) -> None:
        """Grasp the body below the cup, or press the spatula to the table, if it is near enough."""
        pose, state = self.pose, self._state or self._new_state(monitor)
        if self.scene_at_rest.end_effector == "spatula":
            if pose.z > ur5.SWEEP_TIP_Z_M + PRESS_WITHIN_M:
                return
            awake = self._settling is not None
            self._state, self._settling = state, None
            self._go(replace(pose, z=ur5.SWEEP_TIP_Z_M))
            self._spatula = Spatula(state, pose.yaw_rad, awake=awake)
            self._spatula.engage(pose.x, pose.y)
            return
        caught, surface_z = body_under_probe(self._bodies, pose.x, pose.y)
        if caught not in self._bodies.rigid or pose.z > surface_z + ur5.PROBE_BELOW_TIP_M + _TOUCH_M:
            return
        self._state = state
        self._held = HeldBody(caught, self._bodies.pose(caught), pose)
        self._stands_alone, carries_others = take_out(self._bodies, self._held)
        if carries_others or self._settling is not None:
            self._settling = Settling(self._bodies)

    def _let_go(self) -> None:
        """Release the body, or take the spatula off the table."""
        if self._spatula is not None:
            self._settling, self._spatula = self._spatula.release(), None
        held, pose = self._held, self.pose
        if held is None:
            return
        target = self._held_pose(held)
        set_down_at, on_floor = held.lowest(self._bodies, pose.x, pose.y, pose.yaw_rad)
        stands = on_floor and self._stands_alone and target.z - set_down_at.z < _TOUCH_M
        if stands:  # no physics needed, and its height keeps the same value
            target = held.carried(pose.x, pose.y, pose.yaw_rad)
        self._bodies.place(held.index, target)
        self._bodies.refresh()
        self._held = None
        if not stands or self._settling is not None:
            self._settling = Settling(self._bodies)

    def _move(self, command: ToolCommand) -> None:
        """Move the tool by a part of a command, as far as joints and contacts let it."""
        dx, dy, dz, turn = (d / _NUM_PARTS for d in (command.dx, command.dy, command.dz, command.dyaw))
        if self._spatula is not None:
            slower = min(1.0, SWEEP_M_S * _PART_S / max(math.hypot(dx, dy), 1e-12))
            dx, dy, dz, turn = dx * slower, dy * slower, 0.0, turn * slower
        if not any((dx, dy, dz, turn)):
            return
        target = self._reachable((dx, dy, dz, turn)) or self._reachable((dx, dy, dz, 0.0))
        if target is None:
            return
        is_cup = self.scene_at_rest.end_effector == "suction"
        self._go(self._above_contact(target) if is_cup else target)

    def _reachable(self, motion: tuple[float, float, float, float]) -> ToolPose | None:
        """The pose after as much of a motion as the joints allow; None: nothing of it.

        By bisection of the fraction: the whole motion is tried first, which nearly always can be reached.
        """
        found, low, high = None, 0.0, 1.0
        fraction = 1.0
        for _ in range(_BISECTIONS):
            pose = self._after(motion, fraction)
            if self._can_reach(pose):
                found, low = pose, fraction
            else:
                high = fraction
            if low == 1.0:
                break
            fraction = (low + high) / 2
        return found

    def _after(self, motion: tuple[float, float, float, float], fraction: float) -> ToolPose:
        """The pose after a fraction of a motion; it slides along the bounds and the limits of the height.

        Near the rim the lowest height may lie beyond the arm: such a pose cannot be reached.
        """
        pose, (dx, dy, dz, turn) = self.pose, motion
        x, y = (
            min(max(at + fraction * delta, low - _MARGIN_M), high + _MARGIN_M)
            for at, delta, low, high in zip(
                (pose.x, pose.y), (dx, dy), WORKSPACE_LOW, WORKSPACE_HIGH, strict=True
            )
        )
        z = self._within_height(x, y, pose.z + fraction * dz)
        return ToolPose(x, y, z, pose.yaw_rad + fraction * turn)

    def _within_height(self, x: float, y: float, z: float) -> float:
        """The nearest height at which the tool may be above a point."""
        highest = min(HIGHEST_TIP_Z_M, ur5.highest_tip_z(x, y) - ur5.REACH_RESERVE_M)
        lowest = ur5.SWEEP_TIP_Z_M if self.scene_at_rest.end_effector == "spatula" else _LOWEST_CUP_Z_M
        return max(min(z, highest), lowest)

    def _can_reach(self, pose: ToolPose) -> bool:
        try:
            joints = self._joints_at(pose)
        except ActionError:
            return False
        too_fast = np.abs(joints - self._joints) > MAX_JOINT_SPEED * _PART_S
        return not (too_fast | (np.abs(joints) > ur5.JOINT_LIMITS)).any()

    def _joints_at(self, pose: ToolPose) -> np.ndarray:
        """Joint angles for a pose, in the turn nearest to the current ones."""
        joints = ur5.inverse(pose.x, pose.y, pose.z, pose.yaw_rad)
        return joints + 2 * math.pi * np.round((self._joints - joints) / (2 * math.pi))

    def _go(self, pose: ToolPose) -> None:
        self._joints = self._joints_at(pose)
        self.pose = pose

    def _above_contact(self, target: ToolPose) -> ToolPose:
        """Stop at the first contact from above, and beside what is in the way; lifting is always free."""
        pose, highest = self.pose, max(self.pose.z, target.z)
        lowest = self._lowest_z(target)
        if lowest > min(highest + _TOUCH_M, _greatest_z(target.x, target.y)):
            target = replace(pose, z=self._within_height(pose.x, pose.y, target.z))
            lowest = min(self._lowest_z(pose), pose.z)
        return replace(target, z=max(target.z, lowest))

    def _lowest_z(self, pose: ToolPose) -> float:
        """Height of the tip at which the cup, or the held body, lowered at a pose comes into contact."""
        held = self._held
        if held is None:
            return body_under_probe(self._bodies, pose.x, pose.y)[1] + ur5.PROBE_BELOW_TIP_M
        set_down_at, _ = held.lowest(self._bodies, pose.x, pose.y, pose.yaw_rad)
        self._bodies.park(held.index)
        return held.grasp.z + set_down_at.z - held.carried(pose.x, pose.y, pose.yaw_rad).z

    def _held_pose(self, held: HeldBody) -> Pose:
        pose = self.pose
        return held.carried(pose.x, pose.y, pose.yaw_rad).moved(dz=pose.z - held.grasp.z)

    def _held_at(self) -> tuple[int, Pose] | None:
        """Index and pose of the held body, as `PrimitiveState` takes them."""
        return None if self._held is None else (self._held.index, self._held_pose(self._held))

    def _run_physics(self) -> None:
        """Run the physics of a part of a command, if anything moves."""
        pose, state = self.pose, self._state
        if self._spatula is not None:
            self._spatula.slide(pose.x, pose.y, pose.yaw_rad, _PART_TICKS)
        if self._settling is None or state is None:
            return
        held = self._held_at()
        for done in range(0, _PART_TICKS, STRIDE_TICKS):
            num_ticks = min(STRIDE_TICKS, _PART_TICKS - done)
            self._settling.run(num_ticks)
            state.count_ticks(num_ticks, held)
            if self._settling.is_over:
                self._settling = None
                return


def _greatest_z(x: float, y: float) -> float:
    """Height up to which contacts may raise the tool, in metres."""
    return min(HIGHEST_TIP_Z_M, ur5.highest_tip_z(x, y) - _ROUNDING_M)
