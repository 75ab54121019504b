"""What a frame of the export holds: one frame a step, showing what the policy saw before its action."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from openvima.data.records import Demonstration, action_arrays, make_env
from openvima.data.schema import IMAGE_SHAPE, VIEWS
from openvima.env.config import EnvConfig
from openvima.errors import ActionError, DatasetError
from openvima.scene import ACTION_SHAPES, END_EFFECTORS, WORKSPACE_HIGH, WORKSPACE_LOW, RenderedPrompt
from openvima.scene.action import COMMAND_NAMES, CONTROL_HZ, END_EFFECTOR, PRIMITIVES

JOINT_NAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
TOOL_NAMES = ("tool_x", "tool_y", "tool_z", "tool_yaw", "tool_holds")
ACTION_NAMES = tuple(f"{key}.{axis}" for key, length in ACTION_SHAPES.items() for axis in "xyzw"[:length])
MAX_PROMPT_IMAGES = 8  # of the benchmark's prompts: novel_adj
IMAGE_PREFIX = "observation.images."


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """An episode as the frames show it, T steps or commands.

    Args:
        prompt: Text and images.
        rgb: View name to images before each action, shape (T or more, 3, 128, 256), uint8.
        states: Numbers of `observation.state` before each action, float32, shape (T, D), or (T,) of the tool
            alone.
        actions: Shape (T, 12 or 5), float32.
        success: Whether the episode was solved.
    """

    prompt: RenderedPrompt
    rgb: Mapping[str, np.ndarray]
    states: np.ndarray
    actions: np.ndarray
    success: bool

    @property
    def num_steps(self) -> int:
        """Number of actions, T."""
        return len(self.actions)


@dataclass(frozen=True, slots=True)
class FrameLayout:
    """What all frames of an export have in common.

    Args:
        num_prompt_images: The largest number of images in a prompt.
        has_joints: Whether the arm's joints are known throughout; with control "primitives" the state is the
            tool alone without them.
        control: "primitives" or "end_effector".
    """

    num_prompt_images: int
    has_joints: bool
    control: str = PRIMITIVES

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the numbers of `observation.state`."""
        tool = TOOL_NAMES if self.control == END_EFFECTOR else ()
        return (*(JOINT_NAMES if self.has_joints else ()), *tool, "end_effector")

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the numbers of `action`."""
        return COMMAND_NAMES if self.control == END_EFFECTOR else ACTION_NAMES

    @property
    def fps(self) -> int:
        """Frames a second; a step is one of float32, by which LeRobot finds frames."""
        return CONTROL_HZ if self.control == END_EFFECTOR else 1

    @property
    def video_keys(self) -> tuple[str, ...]:
        """Names of the image features: the views, then those of the first prompt image, and so on."""
        prompts = (f"prompt_{n}_{view}" for n in range(self.num_prompt_images) for view in VIEWS)
        return tuple(f"{IMAGE_PREFIX}{name}" for name in (*VIEWS, *prompts))

    def values(self, trajectory: Trajectory) -> dict[str, np.ndarray]:
        """Return what the frames of one episode hold besides images and counters, arrays of T rows."""
        is_last = np.arange(trajectory.num_steps) == trajectory.num_steps - 1
        return {
            "observation.state": trajectory.states,
            "action": trajectory.actions,
            "next.reward": (is_last & trajectory.success).astype(np.float32),
            "next.done": is_last,
            "next.success": is_last & trajectory.success,
        }

    def pictures(self, views: Mapping[str, np.ndarray], prompt: RenderedPrompt) -> dict[str, np.ndarray]:
        """Return the pictures of T frames.

        Args:
            views: View name to images, shape (T, 3, 128, 256), uint8.
            prompt: That of the episode.

        Returns:
            Video key to uint8, shape (T or 1, 3, 128, 256); one picture stands for all T frames. Black where
            the prompt has fewer images than others.
        """
        shown = {f"{IMAGE_PREFIX}{view}": pictures for view, pictures in views.items()}
        for number, image in enumerate(prompt.images.values()):
            for view in VIEWS:
                shown[f"{IMAGE_PREFIX}prompt_{number}_{view}"] = image.rgb[view][None]
        black = np.zeros((1, 3, *IMAGE_SHAPE), np.uint8)
        return {key: shown.get(key, black) for key in self.video_keys}

    def frame(self, observation: Mapping[str, Any], prompt: RenderedPrompt) -> dict[str, Any]:
        """Return an observation in the form in which LeRobot's environments return it.

        Args:
            observation: Of the environment: `rgb`, `ee`, with joints `joints`, and with control
                "end_effector" `tool`.
            prompt: The episode's.

        Returns:
            `pixels`, image name to uint8, shape (128, 256, 3); and `agent_pos`, float32: the numbers of
            `observation.state`. LeRobot names the images `observation.images.{name}`.
        """
        pictures = self.pictures({view: observation["rgb"][view][None] for view in VIEWS}, prompt)
        joints = observation["joints"] if self.has_joints else ()
        tool = observation["tool"] if self.control == END_EFFECTOR else ()
        return {
            "pixels": {
                key.removeprefix(IMAGE_PREFIX): np.moveaxis(picture[0], 0, -1)
                for key, picture in pictures.items()
            },
            "agent_pos": np.array([*joints, *tool, observation["ee"]], np.float32),
        }

    def action(self, row: np.ndarray) -> Any:
        """Return the action or command that a row of `action` stands for, as the environment takes it.

        A regression leaves the bounds by little: positions of primitives are clipped to the workspace, and
        rotations scaled to unit length. What is not finite stays so, and the environment refuses it.

        Args:
            row: Numbers with the names `action_names`, floating-point.

        Raises:
            ActionError: The row has another shape or dtype.
        """
        names = self.action_names
        if row.shape != (len(names),) or not np.issubdtype(row.dtype, np.floating):
            raise ActionError(
                f"the action has shape {row.shape}, dtype {row.dtype}; it must be "
                f"{len(names)} floating-point numbers: {', '.join(names)}."
            )
        row = row.astype(np.float32)
        if self.control == END_EFFECTOR:
            return row
        ends = np.cumsum(list(ACTION_SHAPES.values()))[:-1]
        parts = zip(ACTION_SHAPES, np.split(row, ends), strict=True)
        return {key: _within_bounds(values) for key, values in parts}


def frame_layout(control: str, num_prompt_images: int, has_joints: bool) -> FrameLayout:
    """Return the layout of a control's frames; those of "end_effector" always have joints."""
    return FrameLayout(num_prompt_images, has_joints or control == END_EFFECTOR, control)


def _within_bounds(values: np.ndarray) -> np.ndarray:
    if not np.isfinite(values).all():
        return values
    if len(values) == len(WORKSPACE_LOW):
        return np.clip(values, *np.array([WORKSPACE_LOW, WORKSPACE_HIGH], np.float32))
    return np.clip(values / max(float(np.linalg.norm(values)), 1e-6), -1, 1).astype(np.float32)


def step_trajectory(demo: Demonstration, *, has_joints: bool) -> Trajectory:
    """Return a demonstration with a frame for each step; without joints its states are the tool alone."""
    tool = END_EFFECTORS.index(demo.end_effector)
    states = [(*path[0], tool) for path in demo.joint_paths] if has_joints else [tool] * demo.num_steps
    return Trajectory(
        demo.prompt,
        demo.rgb,
        np.array(states, np.float32),
        np.concatenate([*action_arrays(demo).values()], axis=1),
        demo.outcome.success,
    )


def dense_trajectory(demo: Demonstration, env_config: EnvConfig) -> Trajectory:
    """Replay a demonstration of low-level control, with a frame for each command.

    Args:
        demo: The demonstration.
        env_config: Its settings.

    Raises:
        DatasetError: The arm moves on another path than the stored one.
    """
    env = make_env(demo.task, demo.level, demo.domain, env_config, ("rgb", "joints"))
    observation, _ = env.reset(seed=demo.seed)
    seen, commands = [], []
    for step, (action, path) in enumerate(zip(demo.actions, demo.joint_paths, strict=True)):
        joints = []
        for command in env.commands(action):
            seen.append(observation)
            joints.append(observation["joints"])
            commands.append(command.to_array())
            observation, *_ = env.step(command)
        if not np.array_equal([*joints, observation["joints"]], path):
            raise DatasetError(
                f"{demo.task}, seed {demo.seed}: the path of step {step} differs; other versions wrote it."
            )
    tool = END_EFFECTORS.index(demo.end_effector)
    return Trajectory(
        demo.prompt,
        {view: np.stack([each["rgb"][view] for each in seen]) for view in demo.rgb},
        np.array([(*each["joints"], *each["tool"], tool) for each in seen], np.float32),
        np.array(commands, np.float32),
        demo.outcome.success,
    )
