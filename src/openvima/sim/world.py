"""The simulated world: bodies, arm and tool."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.scene import Action, Scene
from openvima.sim import primitives, ur5
from openvima.sim.arm_path import ArmPath, RecordFrame
from openvima.sim.bodies import Bodies
from openvima.sim.primitive_state import PrimitiveState, is_at_rest

SEPARATION_SPEED = 0.1  # m/s, of bodies that overlap at the start, as in VIMA-Bench


@dataclass(frozen=True, slots=True, eq=False)
class Execution:
    """Result of one primitive.

    Args:
        grasped: Id of the lifted object; None without one, and always for the spatula.
        joint_path: Waypoints of the arm, shape (W, 6), float32, radians, joined by straight lines in joint
            space (straight lines of the tool while sweeping).
        num_ticks: Number of physics ticks of 1/240 s.
        completed: Whether everything came to rest within 1000 ticks.
    """

    grasped: int | None
    joint_path: np.ndarray
    num_ticks: int
    completed: bool


class World:
    """The table with its objects and the robot.

    Deterministic: equal scenes, assets and actions give equal bytes.

    Args:
        scene: The objects at the start. Those that hover or overlap settle in the first primitive.
        assets: Asset pack.
        compat: Move the spatula straight in joint space, as VIMA-Bench's arm does, and stop it 3 mm earlier.

    Raises:
        UnknownObjectError: An object is not in the catalogue.
        AssetError: The asset pack lacks a file.

    Example:
        >>> world = World(scene, assets)  # doctest: +SKIP
        >>> world.execute(Action.planar((0.4, 0.1), (0.6, -0.2), yaw_rad=0.5)).grasped  # doctest: +SKIP
        5
    """

    def __init__(self, scene: Scene, assets: Assets, *, compat: bool = False) -> None:
        self._scene = scene
        self._bodies = Bodies(scene, assets)
        self._compat = compat
        self._joints = ur5.HOME
        self._is_settled = is_at_rest(self._bodies)

    @property
    def scene(self) -> Scene:
        """The current scene."""
        return self._scene

    @property
    def joints(self) -> np.ndarray:
        """Current joint angles of the arm, shape (6,), float64, radians."""
        return self._joints.copy()

    def execute(
        self,
        action: Action,
        *,
        monitor: Callable[[Scene], None] | None = None,
        record: RecordFrame | None = None,
        frames_per_second: float = 30,
    ) -> Execution:
        """Execute one action: pick and place, or sweep, depending on the end effector.

        Monitoring and recording do not change the result.

        Args:
            action: The action; positions lie in the workspace.
            monitor: Called with the scene at least every 25 ticks while bodies may move, and at the end.
            record: Called with scene and joints, shape (6,), for every video frame.
            frames_per_second: Frame rate in simulated time.

        Returns:
            The result; `scene` and `joints` are updated.
        """
        path = ArmPath(self._joints, record, frames_per_second)
        state = PrimitiveState(self._scene, self._bodies, path, monitor)
        if not self._is_settled:
            state.settle(max_speed=SEPARATION_SPEED)
            self._is_settled = True
        grasped = self._perform(state, action)
        self._scene = state.finish()
        self._joints = path.joints
        grasped_id = None if grasped is None else state.placement(grasped).id
        return Execution(grasped_id, path.array(), state.num_ticks, state.completed)

    def _perform(self, state: PrimitiveState, action: Action) -> int | None:
        if self._scene.end_effector == "suction":
            return primitives.pick_place(state, action)
        primitives.sweep(state, action, compat=self._compat)
        return None
