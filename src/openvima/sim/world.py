"""A scene that can be acted upon: bodies, arm and tool."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.scene import Action, Scene
from openvima.sim import primitives, ur5
from openvima.sim.arm_path import ArmPath, RecordFrame
from openvima.sim.bodies import Bodies
from openvima.sim.stage import Stage, is_at_rest

_PARTING_SPEED = 0.1  # m/s, with which bodies that were loaded overlapping part, as gently as in VIMA-Bench


@dataclass(frozen=True, slots=True, eq=False)
class Execution:
    """What one primitive did.

    Args:
        grasped: Id of the object that was lifted; None if there was none, and always for the spatula.
        joint_path: Key positions of the arm from start to end, shape (W, 6), float32, radians; it moves in
            straight lines in joint space between them (in a straight line of the tool while sweeping).
        num_ticks: Physics steps of 1/240 s that were computed.
        completed: Whether everything came to rest within the limit of 1000 ticks.
    """

    grasped: int | None
    joint_path: np.ndarray
    num_ticks: int
    completed: bool


class World:
    """The table with its objects and the robot.

    Deterministic: equal scenes, assets and actions give equal bytes. Nothing depends on time or on other
    worlds.

    Args:
        scene: The objects at their start. Those that hover or overlap come to rest during the first
            primitive.
        assets: Gives the shapes.
        compat: Move the blade as the benchmark's arm does: it descends, pushes and rises in bows, straight in
            joint space, and ends 3 mm earlier.

    Raises:
        UnknownObjectError: The scene holds an object that the catalogue does not know.
        AssetError: The asset pack lacks one of its files.

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
        """All objects with the present poses of their link frames."""
        return self._scene

    @property
    def joints(self) -> np.ndarray:
        """Present joint angles of the arm, shape (6,), float64, radians. It stays where a primitive ends."""
        return self._joints.copy()

    def execute(
        self,
        action: Action,
        *,
        watch: Callable[[Scene], None] | None = None,
        record: RecordFrame | None = None,
        frames_per_second: float = 30,
    ) -> Execution:
        """Carry out one action: pick and place, or sweep, as the scene's end effector does.

        Watching and recording change nothing about what happens.

        Args:
            action: The action; positions lie in the workspace.
            watch: Called with the scene at least every 25 ticks while bodies may move, and at the end.
            record: Called with scene and joints, shape (6,), for every frame of a film of the arm at work.
            frames_per_second: Of that film, in simulated time.

        Returns:
            What happened; `scene` and `joints` hold the new state.
        """
        path = ArmPath(self._joints, record, frames_per_second)
        stage = Stage(self._scene, self._bodies, path, watch)
        if not self._is_settled:
            stage.settle(top_speed=_PARTING_SPEED)
            self._is_settled = True
        grasped = self._perform(stage, action)
        self._scene = stage.finish()
        self._joints = path.joints
        grasped_id = None if grasped is None else stage.placement(grasped).id
        return Execution(grasped_id, path.array(), stage.num_ticks, stage.completed)

    def _perform(self, stage: Stage, action: Action) -> int | None:
        if self._scene.end_effector == "suction":
            return primitives.pick_place(stage, action)
        primitives.sweep(stage, action, compat=self._compat)
        return None
