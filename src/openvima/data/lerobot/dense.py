"""Dense trajectories: demonstrations of low-level control, with a frame for each command of the tool.

Data sets of that control hold primitives and the arm's path. The simulation is deterministic, so replaying
gives every command, image and state in between.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from openvima.catalog.user_assets import recorded_assets
from openvima.data.lerobot.features import JOINT_NAMES, FrameLayout, check_row
from openvima.data.reader import Dataset
from openvima.data.records import Demonstration
from openvima.env.config import EnvConfig
from openvima.errors import DatasetError
from openvima.scene import END_EFFECTORS, RenderedPrompt
from openvima.scene.command import COMMAND_NAMES, END_EFFECTOR

if TYPE_CHECKING:  # comes with the simulator
    from openvima.env import TabletopEnv

TOOL_NAMES = ("tool_x", "tool_y", "tool_z", "tool_yaw", "tool_holds")


@dataclass(frozen=True, slots=True, eq=False)
class DenseTrajectory:
    """A demonstration of low-level control, T commands.

    Args:
        task: Name of the task.
        prompt: Text and images.
        rgb: View name to images before each command, shape (T, 3, 128, 256), uint8.
        states: Joints, `TOOL_NAMES` and end effector before each command, shape (T, 12), float32.
        commands: Shape (T, 5), float32.
        success: Whether the episode was solved.
    """

    task: str
    prompt: RenderedPrompt
    rgb: Mapping[str, np.ndarray]
    states: np.ndarray
    commands: np.ndarray
    success: bool

    @property
    def num_steps(self) -> int:
        """Number of commands, T."""
        return len(self.commands)


class DenseLayout(FrameLayout):
    """What all frames of an export of low-level control have in common."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the numbers of `observation.state`."""
        return (*JOINT_NAMES, *TOOL_NAMES, "end_effector")

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the numbers of `action`."""
        return COMMAND_NAMES

    def values(self, demo: DenseTrajectory) -> dict[str, np.ndarray]:  # type: ignore[override]  # of its own kind
        """Return what the frames of one trajectory hold besides images and counters, arrays of T rows."""
        is_last = np.arange(demo.num_steps) == demo.num_steps - 1
        success = is_last & demo.success
        return {
            "observation.state": demo.states,
            "action": demo.commands,
            "next.reward": success.astype(np.float32),
            "next.done": is_last,
            "next.success": success,
        }

    def frame(self, observation: Mapping[str, Any], prompt: RenderedPrompt) -> dict[str, Any]:
        """Return an observation of the environment in the form in which LeRobot's environments return it."""
        values = (*observation["joints"], *observation["tool"], observation["ee"])
        return {**FrameLayout.frame(self, observation, prompt), "agent_pos": np.array(values, np.float32)}

    def action(self, row: np.ndarray) -> np.ndarray:
        """Return the command that a row of `action` stands for, as the environment takes it.

        Raises:
            ActionError: The row has another shape or dtype.
        """
        check_row(row, COMMAND_NAMES)
        return row.astype(np.float32)


def frame_layout(control: str, num_prompt_images: int, has_joints: bool) -> FrameLayout:
    """Return the layout of a control's frames; those of "end_effector" always have joints."""
    kind = DenseLayout if control == END_EFFECTOR else FrameLayout
    return kind(num_prompt_images, has_joints)


def dense_settings(dataset: Dataset) -> dict[tuple[str, str], EnvConfig]:
    """Return the settings of each task and level of a data set of low-level control; else nothing.

    Raises:
        DatasetError: Some of the demonstrations are of low-level control, and others are not.
    """
    infos = [dataset.shard(name).info for name in dataset.shard_names()]
    controls = sorted({info.control for info in infos})
    if len(controls) > 1:
        raise DatasetError(f"{dataset.path} mixes controls {', '.join(controls)}; export each by itself.")
    if controls == [EnvConfig().control]:
        return {}
    return {(i.task, i.level): replace(i.env_config, assets=recorded_assets(i.assets)) for i in infos}


def dense_trajectory(demo: Demonstration, env_config: EnvConfig) -> DenseTrajectory:
    """Replay a demonstration of low-level control.

    Args:
        demo: The demonstration.
        env_config: Its settings.

    Raises:
        DatasetError: The arm moves on another path than the stored one.
    """
    env = _env(demo.task, demo.level, demo.domain, env_config)
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
    return DenseTrajectory(
        demo.task,
        demo.prompt,
        {view: np.stack([each["rgb"][view] for each in seen]) for view in demo.rgb},
        np.array([(*each["joints"], *each["tool"], tool) for each in seen], np.float32),
        np.array(commands, np.float32),
        demo.outcome.success,
    )


@lru_cache(maxsize=4)
def _env(task: str, level: str, domain: str, env_config: EnvConfig) -> "TabletopEnv":
    env = env_config.make(task, level, domain=domain)
    env.modalities = ("rgb", "joints")
    return env
