"""The configuration that `lerobot-eval --env.type=openvima` builds environments from."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_env_openvima.env import OpenVimaEnv
from openvima.data.lerobot_frames import IMAGE_PREFIX, MAX_PROMPT_IMAGES, FrameLayout, frame_layout
from openvima.env.tabletop import IMAGE_SHAPE
from openvima.errors import ConfigError
from openvima.scene.action import END_EFFECTOR, PRIMITIVES, check_control


@EnvConfig.register_subclass("openvima")
@dataclass
class OpenVimaEnvConfig(EnvConfig):
    """Environments of one or more tasks at one level, with evaluation seeds.

    Args:
        task: Name of the task, or several with commas between them.
        level: "train", "L1", "L2", "L3" or "L4".
        prompts: Form of the prompts, as `openvima.make` takes it: "multimodal", "text" or "mixed".
        num_prompt_images: Prompt images of an observation; those that a prompt lacks are black.
        joints: Whether `observation.state` begins with the arm's joints, as that of generated demonstrations.
        control: "primitives"; or "end_effector", with commands of the tool, ten a second.
        fps: Frames a second of videos and recordings; a frame is a step. By default 10 with control
            "end_effector", the true rate, else 1.

    Raises:
        ConfigError: There is no such control, or it is "end_effector" without joints.
    """

    task: str | None = "rotate"
    fps: int = 0
    level: str = "L1"
    prompts: str = "multimodal"
    num_prompt_images: int = MAX_PROMPT_IMAGES
    joints: bool = True
    control: str = PRIMITIVES

    def __post_init__(self) -> None:
        check_control(self.control)
        if self.control == END_EFFECTOR and not self.joints:
            raise ConfigError("joints is False; with control 'end_effector' observations always hold them.")
        self.fps = self.fps or self.layout.fps
        images = [key.removeprefix(IMAGE_PREFIX) for key in self.layout.video_keys]
        image = PolicyFeature(FeatureType.VISUAL, (*IMAGE_SHAPE, 3))
        self.features = {
            **{f"pixels/{name}": image for name in images},
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(self.layout.state_names),)),
            ACTION: PolicyFeature(FeatureType.ACTION, (len(self.layout.action_names),)),
        }
        self.features_map = {
            **{f"pixels/{name}": f"{IMAGE_PREFIX}{name}" for name in images},
            "agent_pos": OBS_STATE,
            ACTION: ACTION,
        }

    @property
    def layout(self) -> FrameLayout:
        """What observations hold."""
        return frame_layout(self.control, self.num_prompt_images, self.joints)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of every environment besides its task."""
        settings = {"level": self.level, "prompts": self.prompts, "control": self.control}
        return {**settings, "layout": self.layout, "fps": self.fps}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """Build a vector environment for each task: {task: {0: environment}}."""
        mode = gymnasium.vector.AutoresetMode.SAME_STEP
        envs: dict[str, dict[int, gymnasium.vector.VectorEnv]] = {}
        for task in (self.task or "").split(","):
            functions = [partial(OpenVimaEnv, task.strip(), **self.gym_kwargs)] * n_envs
            if use_async_envs and n_envs > 1:
                env = gymnasium.vector.AsyncVectorEnv(functions, autoreset_mode=mode, context="forkserver")
            else:
                env = gymnasium.vector.SyncVectorEnv(functions, autoreset_mode=mode)
            envs[task.strip()] = {0: env}
        return envs
