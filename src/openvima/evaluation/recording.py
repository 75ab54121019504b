"""Episodes as videos and images, and online evaluation of checkpoints during training."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.atomic_io import atomic_write_file
from openvima.env.config import DEFAULT_ENV_CONFIG, EnvConfig
from openvima.env.tabletop import TabletopEnv
from openvima.errors import PolicyError
from openvima.evaluation.results import EpisodeOutcome
from openvima.evaluation.rollout import begin_episode, play
from openvima.evaluation.rollout_policies import (
    OracleRolloutPolicy,
    PromptedRolloutPolicy,
    RolloutPolicy,
    explainer_of,
)
from openvima.input_files import as_path
from openvima.policies.base import POLICIES_THAT_EXPLAIN
from openvima.policies.loading import load_policy
from openvima.scene import Episode
from openvima.sim.primitive_state import FRAMES_PER_SECOND
from openvima.video.encoder import Animation, png
from openvima.video.prompt_strip import MUTED, PAPER, draw_prompt_strip, font
from openvima.video.recorder import EpisodeRecorder, SceneRenderer

_GAP = 12  # pixels between the parts


def record_episode(
    env: TabletopEnv,
    policy: RolloutPolicy,
    start: int | Episode,
    path: Path,
    *,
    title: str = "",
    with_prompt: bool = True,
    explain: bool = False,
    may_fail: bool = False,
) -> EpisodeOutcome:
    """Roll out one episode and record it in real time.

    Args:
        env: An environment with `realtime`.
        policy: Decides the actions.
        start: The episode, or its seed.
        path: The MP4 file to write.
        title: Caption below the scene; no caption if empty.
        with_prompt: Whether to draw the prompt above the scene.
        explain: Whether to draw what the policy considered beside the scene.
        may_fail: As for `openvima.evaluation.rollout.play`.

    Returns:
        How the episode ended.

    Raises:
        PolicyError: The policy explains nothing.
    """
    explainer = explainer_of(policy) if explain else None
    if explain and explainer is None:
        raise PolicyError(f"the policy has no explain(). {POLICIES_THAT_EXPLAIN}")
    begin_episode(env, start)
    with EpisodeRecorder(env, path, title=title, with_prompt=with_prompt, explain=explainer) as recorder:
        (outcome,) = play([env], [start], policy, after_step=recorder.record_step, may_fail=may_fail)
        recorder.record_outcome(outcome.success if env.episode.problem.goals else None, outcome.steps)
    return outcome


def save_episode_image(
    env: TabletopEnv, path: str | Path, *, seed: int, policy: RolloutPolicy | None = None, enlarge: int = 2
) -> EpisodeOutcome:
    """Roll out one episode and save an image of it: the prompt above, start and end side by side.

    Args:
        env: The environment.
        path: The PNG file to write.
        seed: The episode's seed.
        policy: Decides the actions; by default the oracle.
        enlarge: Factor on the benchmark's images of 128 × 256 pixels.

    Returns:
        How the episode ended.
    """
    renderer = SceneRenderer(env, enlarge)
    env.reset(seed=seed)
    start = renderer.draw(env.scene, joints=None)
    (outcome,) = play([env], [seed], policy or OracleRolloutPolicy())
    end = renderer.draw(env.scene, joints=None)
    ended = "after: solved" if outcome.success else "after: not solved"
    scenes = np.concatenate([_titled(start, "before"), _titled(end, ended)], axis=1)
    scenes = np.pad(scenes, ((0, 0), (0, _GAP), (0, 0)), constant_values=255)
    image = np.concatenate([draw_prompt_strip(env.prompt, width=scenes.shape[1]), scenes])
    atomic_write_file(as_path(path), png(Image.fromarray(image)))
    return outcome


def _titled(image: np.ndarray, title: str) -> np.ndarray:
    """Put a title above an image, and a gap to the left and below."""
    height, width, _ = image.shape
    framed = Image.new("RGB", (_GAP + width, 26 + height + _GAP), PAPER)
    ImageDraw.Draw(framed).text((_GAP, 13), title, font=font(14), fill=MUTED, anchor="lm")
    framed.paste(Image.fromarray(image), (_GAP, 26))
    return np.asarray(framed)


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
    """

    tasks: tuple[str, ...]
    episodes: int
    env_config: EnvConfig = DEFAULT_ENV_CONFIG

    def __call__(self, checkpoint: Path) -> dict[str, float]:
        """Return the success rate of each task, and their mean as "success"."""
        policy = load_policy(str(checkpoint), trust_code=True)  # the training runs it
        rates, seeds = {}, range(self.episodes)
        for task in self.tasks:
            envs = [self.env_config.make(task, ONLINE_EVAL_LEVEL, domain=_DOMAIN) for _ in seeds]
            outcomes = play(envs, seeds, PromptedRolloutPolicy(policy))
            rates[task] = sum(outcome.success for outcome in outcomes) / len(outcomes)
        return {"success": sum(rates.values()) / len(rates), **rates}

    def animate(self, checkpoint: Path) -> list[Animation]:
        """Roll out the first episode of each task, and return it with the picture of its prompt."""
        policy = load_policy(str(checkpoint), trust_code=True)
        return [self._animation(task, policy) for task in self.tasks]

    def _animation(self, task: str, policy: object) -> Animation:
        env = self.env_config.make(task, ONLINE_EVAL_LEVEL, domain=_DOMAIN, realtime=True)
        env.reset(seed=0)
        renderer = SceneRenderer(env, enlarge=1)
        frames = [renderer.draw(env.scene)]

        def record(env: TabletopEnv) -> None:
            shown = (*env.frames[::_FRAME_STRIDE], env.frames[-1])
            frames.extend(renderer.draw(frame.scene, frame.joints) for frame in shown)

        (outcome,) = play([env], [0], PromptedRolloutPolicy(policy), after_step=record)
        caption = f"solved (steps: {outcome.steps})" if outcome.success else outcome.reason
        prompt = draw_prompt_strip(env.prompt, width=_PROMPT_WIDTH)
        rate = FRAMES_PER_SECOND // _FRAME_STRIDE
        return Animation(task, caption, prompt, np.stack(frames), rate)
