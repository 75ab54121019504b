"""An openvima environment with the observations, actions and infos that LeRobot expects."""

import logging
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from openvima.data.lerobot_frames import FrameLayout
from openvima.env.tabletop import IMAGE_SHAPE, TabletopEnv
from openvima.errors import ActionError
from openvima.scene.action import steps_per_primitive


class OpenVimaEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """Episodes of one task and level; `reset(seed=k)` starts episode k of `openvima evaluate`.

    Args:
        task: Name of the task.
        level: As for `openvima.make`.
        prompts: As for `openvima.make`.
        control: As for `openvima.make`.
        layout: What observations and actions hold; that of the control.
        fps: Frames a second of videos.
    """

    def __init__(
        self, task: str, *, level: str, prompts: str, control: str, layout: FrameLayout, fps: int
    ) -> None:
        self.task = task
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": fps}
        self.render_mode = "rgb_array"
        self._layout = layout
        self._env = TabletopEnv(
            task,
            level=level,
            domain="eval",
            prompts=prompts,
            control=control,
            modalities=("rgb", "joints"),
            render_mode=self.render_mode,
        )
        self._observation: dict[str, Any] = {}
        names = [key.rpartition(".")[2] for key in layout.video_keys]
        image = spaces.Box(0, 255, (*IMAGE_SHAPE, 3), np.uint8)
        state = spaces.Box(-np.inf, np.inf, (len(layout.state_names),), np.float32)
        self.observation_space = spaces.Dict(
            {"pixels": spaces.Dict(dict.fromkeys(names, image)), "agent_pos": state}
        )
        self.action_space = spaces.Box(-1, 1, (len(layout.action_names),), np.float32)

    @property
    def task_description(self) -> str:
        """The prompt with its placeholders, as `task` of the export."""
        return self._env.prompt.text

    @property
    def _max_episode_steps(self) -> int:  # LeRobot's name; the same for all episodes of a task
        return self._env.episode.max_steps * steps_per_primitive(self._env.control)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; LeRobot's options mean nothing here."""
        observation, _ = self._env.reset(seed=seed)
        return self._seen(observation), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Execute a row of `action`. An invalid one ends the episode as a failure, as in our evaluation."""
        try:
            observation, reward, terminated, truncated, info = self._env.step(self._layout.action(action))
        except ActionError as error:
            logging.warning("the episode ends: %s", error)
            return self._observation, 0.0, True, False, {"is_success": False}
        return self._seen(observation), reward, terminated, truncated, {"is_success": info["success"]}

    def render(self) -> np.ndarray:
        """Return both views, front above top, shape (256, 256, 3), uint8."""
        return self._env.render()  # type: ignore[return-value]  # there is a render mode

    def _seen(self, observation: dict[str, Any]) -> dict[str, Any]:
        self._observation = self._layout.frame(observation, self._env.prompt)
        return self._observation
