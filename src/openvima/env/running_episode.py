"""A running episode under either control: primitives, or commands of the tool."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.errors import ActionError, brief_repr, echo
from openvima.scene import Action, Episode, Outcome, RenderedPrompt, Scene
from openvima.scene.action import END_EFFECTOR, PRIMITIVES, STAY, ToolCommand, steps_per_primitive
from openvima.sim.tool_path import PathFollower, onward_path, tool_path
from openvima.sim.tool_world import ToolWorld
from openvima.sim.world import World
from openvima.tasks import goals
from openvima.tasks.goals import Progress
from openvima.tasks.oracle import OracleDecision
from openvima.tasks.sampling import make_rng


@dataclass(frozen=True, slots=True, eq=False)
class VideoFrame:
    """One frame of a video, not yet rendered.

    Args:
        scene: The scene.
        joints: Joint angles of the arm, shape (6,), radians.
    """

    scene: Scene
    joints: np.ndarray

    __repr__ = brief_repr


def _arrays(action: Action | ToolCommand) -> Any:
    """Return the arrays of an action, whose values its constructor does not check."""
    try:
        return action.to_arrays() if isinstance(action, Action) else action.to_array()
    except (TypeError, ValueError, OverflowError, RuntimeError):
        raise ActionError(
            f"the action is {echo(repr(action))}; its values must be numbers. Nothing was moved."
        ) from None


@dataclass(slots=True, eq=False)
class PrimitiveRun:
    """State of a running episode; a step is one primitive.

    Args:
        episode: The episode.
        assets: Asset pack.
        compat: Reproduce VIMA-Bench's quirks.
        realtime: Keep video frames from now on.
    """

    control: ClassVar[str] = PRIMITIVES

    episode: Episode
    assets: Assets
    compat: bool
    realtime: bool = False
    world: World | ToolWorld = field(init=False)
    progress: Progress = field(init=False)
    oracle_rng: np.random.Generator = field(init=False)
    outcome: Outcome = field(default_factory=Outcome)
    num_steps: int = 0
    grasped: int | None = None
    joint_path: np.ndarray = field(default_factory=lambda: np.zeros((0, 6), np.float32))
    frames: list[VideoFrame] = field(default_factory=list)
    prompt: RenderedPrompt | None = None

    def __post_init__(self) -> None:
        episode = self.episode
        self.world = self.build_world()
        self.progress = goals.begin(episode.problem)
        self.oracle_rng = make_rng(
            episode.domain, episode.task, episode.level, episode.seed, purpose="oracle"
        )

    def build_world(self) -> World | ToolWorld:
        """Build the world at the start of the episode."""
        return World(self.episode.problem.scene, self.assets, compat=self.compat)

    @property
    def scene_at_rest(self) -> Scene:
        """The scene when everything was last at rest."""
        return self.world.scene

    @property
    def is_out_of_steps(self) -> bool:
        """Whether the step limit is reached."""
        return self.num_steps >= self.episode.max_steps * steps_per_primitive(self.control)

    def checked(self, action: object) -> Any:
        """Validate an action.

        Raises:
            ActionError: It is invalid.
        """
        arrays: Any = _arrays(action) if isinstance(action, Action) else action
        return Action.from_arrays(arrays)

    def step(self, action: Any) -> None:
        """Execute a checked action, and evaluate the goals."""
        self.frames = []
        assert isinstance(self.world, World)
        execution = self.world.execute(action, **self.watchers())
        self.grasped, self.joint_path = execution.grasped, execution.joint_path
        self.num_steps += 1
        self.judge()

    def perform(self, action: Action) -> None:
        """Execute a primitive."""
        self.step(action)

    def watchers(self) -> dict[str, Any]:
        """Return what is called during motion: to test constraints, and to keep video frames."""

        def monitor(scene: Scene) -> None:
            self.progress = goals.monitor(self.episode.problem, self.progress, scene)

        def record(scene: Scene, joints: np.ndarray) -> None:
            self.frames.append(VideoFrame(scene, np.array(joints)))

        is_monitored = goals.needs_monitoring(self.episode.problem)
        return {"monitor": monitor if is_monitored else None, "record": record if self.realtime else None}

    def judge(self) -> None:
        """Evaluate goals and constraints; everything is at rest."""
        self.progress, self.outcome = goals.advance(self.episode.problem, self.progress, self.world.scene)

    def observed_tool(self) -> dict[str, np.ndarray]:
        """What observations hold of the tool, besides the modalities."""
        return {}


@dataclass(slots=True, eq=False)
class ToolRun(PrimitiveRun):
    """State of a running episode; a step is one command of 0.1 s.

    Goals are evaluated when a manipulation has ended, as after a primitive.
    """

    control: ClassVar[str] = END_EFFECTOR

    follower: PathFollower | None = None  # of the oracle, as long as its commands are executed
    advice: ToolCommand | None = None  # the oracle's command for the current state

    def build_world(self) -> ToolWorld:
        """Build the world at the start of the episode."""
        return ToolWorld(self.episode.problem.scene, self.assets)

    @property
    def tool_world(self) -> ToolWorld:
        """The world."""
        assert isinstance(self.world, ToolWorld)
        return self.world

    @property
    def scene_at_rest(self) -> Scene:
        """The scene before the tool took hold."""
        return self.tool_world.scene_at_rest

    def checked(self, action: object) -> ToolCommand:
        """Validate a command.

        Raises:
            ActionError: It is invalid.
        """
        return ToolCommand.from_array(_arrays(action) if isinstance(action, ToolCommand) else action)

    def step(self, action: ToolCommand) -> None:
        """Follow a checked command; evaluate the goals where a manipulation has ended."""
        world, before = self.tool_world, self.world.joints
        self.frames = []
        if action != self.advice:
            self.follower = None
        self.advice = None
        has_ended = world.command(action, **self.watchers())
        self.grasped = world.grasped
        self.joint_path = np.array([before, world.joints], np.float32)
        self.num_steps += 1
        if has_ended:
            self.judge()

    def commands(self, action: Action) -> Iterator[ToolCommand]:
        """Yield the commands of a primitive until the episode is over; each is to be executed at once."""
        tool = self.episode.problem.scene.end_effector
        follower = PathFollower(tool_path(action, tool, compat=self.compat))
        while not (self.outcome.is_over or self.is_out_of_steps):
            command = follower.next_command(self.tool_world)
            if command is None:
                return
            yield self.checked(command)

    def perform(self, action: Action) -> None:
        """Execute a primitive as a sequence of commands."""
        path, frames = [self.world.joints], []
        for command in self.commands(action):
            self.step(command)
            path.append(self.world.joints)
            frames += self.frames
        self.joint_path, self.frames = np.array(path, np.float32), frames

    def oracle_command(self, decide: Callable[[], OracleDecision]) -> ToolCommand:
        """Return the oracle's next command: the next of its path, or of a new one if another was executed.

        Args:
            decide: Gives the oracle's next primitive.
        """
        if self.advice is None:
            world = self.tool_world
            command = self.follower and self.follower.next_command(world)
            if command is None:
                decision = decide()
                path = onward_path(decision.action, decision.pick_id, world, compat=self.compat)
                self.follower = PathFollower(path)
                command = self.follower.next_command(world)
            self.advice = self.checked(command or STAY)
        return self.advice

    def observed_tool(self) -> dict[str, np.ndarray]:
        """Position of the tip and heading of the tool, and whether it holds."""
        world, pose = self.tool_world, self.tool_world.pose
        return {"tool": np.array([pose.x, pose.y, pose.z, pose.yaw_rad, world.holds], np.float32)}


RUNS: Mapping[str, type[PrimitiveRun]] = {run.control: run for run in (PrimitiveRun, ToolRun)}
