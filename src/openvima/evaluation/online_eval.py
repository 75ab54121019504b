"""Online evaluation of checkpoints during training."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from openvima.env.config import DEFAULT_ENV_CONFIG, EnvConfig
from openvima.env.running_episode import FRAMES_PER_SECOND
from openvima.env.tabletop import TabletopEnv
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.policies.loading import load_policy
from openvima.video.animation import Animation
from openvima.video.prompt_strip import draw_prompt_strip
from openvima.video.recorder import SceneRenderer

ONLINE_EVAL_LEVEL = "L1"
_DOMAIN = "user"  # evaluation episodes are kept for finished policies
_FRAME_STRIDE = 5  # of 30 frames a second
_PROMPT_WIDTH = 512  # pixels


@dataclass(frozen=True, slots=True)
class OnlineEval:
    """Evaluates checkpoints on the same episodes of some tasks.

    Args:
        tasks: Names of the tasks.
        episodes: Episodes of each task, at level L1; none of them occurs in training or evaluation.
        env_config: Settings of the environments.
        device: Where the policy computes.
    """

    tasks: tuple[str, ...]
    episodes: int
    env_config: EnvConfig = DEFAULT_ENV_CONFIG
    device: str = "cpu"

    def __call__(self, checkpoint: Path) -> dict[str, float]:
        """Return the success rate of each task, and their mean as "success"."""
        policy = load_policy(str(checkpoint), device=self.device, trust_code=True)  # the training runs it
        rates = {task: self._rate(task, policy) for task in self.tasks}
        return {"success": sum(rates.values()) / len(rates), **rates}

    def animate(self, checkpoint: Path) -> list[Animation]:
        """Roll out the first episode of each task, and return it with the picture of its prompt."""
        policy = load_policy(str(checkpoint), device=self.device, trust_code=True)
        return [self._animation(task, policy) for task in self.tasks]

    def _animation(self, task: str, policy: object) -> Animation:
        env = self.env_config.make(task, ONLINE_EVAL_LEVEL, domain=_DOMAIN, realtime=True)
        env.reset(seed=0)
        renderer = SceneRenderer(env, enlarge=1)
        frames = [renderer.draw(env.scene)]

        def record(env: TabletopEnv) -> None:
            frames.extend(renderer.draw(frame.scene, frame.joints) for frame in env.frames[::_FRAME_STRIDE])
            frames.append(renderer.draw(env.frames[-1].scene, env.frames[-1].joints))

        (outcome,) = play([env], [0], PromptedRolloutPolicy(policy), after_step=record)
        caption = f"solved (steps: {outcome.steps})" if outcome.success else outcome.reason
        prompt = draw_prompt_strip(env.prompt, width=_PROMPT_WIDTH)
        rate = FRAMES_PER_SECOND // _FRAME_STRIDE
        return Animation(task, caption, prompt, np.stack(frames), rate)

    def _rate(self, task: str, policy: object) -> float:
        seeds = range(self.episodes)
        envs = [self.env_config.make(task, ONLINE_EVAL_LEVEL, domain=_DOMAIN) for _ in seeds]
        outcomes = play(envs, seeds, PromptedRolloutPolicy(policy))
        return sum(outcome.success for outcome in outcomes) / len(outcomes)
