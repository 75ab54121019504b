"""Rolling out single episodes on video, or as one image of start and end."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.atomic_io import atomic_write_file
from openvima.env.tabletop import TabletopEnv
from openvima.errors import PolicyError
from openvima.evaluation.results import EpisodeOutcome
from openvima.evaluation.rollout import begin_episode, play
from openvima.evaluation.rollout_policies import OracleRolloutPolicy, RolloutPolicy
from openvima.input_files import as_path
from openvima.scene import Episode
from openvima.scene.explanation import Explanation
from openvima.video.clips import png
from openvima.video.prompt_strip import MUTED, PAPER, draw_prompt_strip, font
from openvima.video.recorder import ENLARGE, EpisodeRecorder, SceneRenderer

_GAP = 12  # pixels between the parts


def record_episode(
    env: TabletopEnv,
    policy: RolloutPolicy,
    start: int | Episode,
    path: Path,
    *,
    title: str = "",
    with_prompt: bool = True,
    enlarge: int = ENLARGE,
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
        enlarge: Factor on the benchmark's images.
        explain: Whether to draw what the policy considered beside the scene, at the default size.
        may_fail: As for `openvima.evaluation.rollout.play`.

    Returns:
        How the episode ended.

    Raises:
        PolicyError: The policy explains nothing.
    """
    explainer = _explainer(policy) if explain else None
    begin_episode(env, start)
    with EpisodeRecorder(
        env, path, title=title, with_prompt=with_prompt, enlarge=enlarge, explain=explainer
    ) as recorder:
        (outcome,) = play([env], [start], policy, after_step=recorder.record_step, may_fail=may_fail)
        recorder.record_outcome(outcome.success if env.episode.problem.goals else None, outcome.steps)
    return outcome


def _explainer(policy: RolloutPolicy) -> Callable[[], Explanation]:
    """Return the function that explains the last action in the only episode of a policy."""
    explain_all = policy.explainer()

    def explain() -> Explanation:
        (explanation,) = explain_all()
        if explanation is None:
            raise PolicyError("explain() of the policy returned None for an episode that goes on.")
        return explanation

    return explain


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
    gap = np.full((start.shape[0] + 26, _GAP, 3), 255, np.uint8)
    ended = "after: solved" if outcome.success else "after: not solved"
    scenes = np.concatenate([gap, _titled(start, "before"), gap, _titled(end, ended), gap], axis=1)
    strip = draw_prompt_strip(env.prompt, width=scenes.shape[1])
    image = np.concatenate([strip, scenes, np.full((_GAP, scenes.shape[1], 3), 255, np.uint8)])
    atomic_write_file(as_path(path), png(Image.fromarray(image)))
    return outcome


def _titled(image: np.ndarray, title: str) -> np.ndarray:
    line = Image.new("RGB", (image.shape[1], 26), PAPER)
    ImageDraw.Draw(line).text((0, 13), title, font=font(14), fill=MUTED, anchor="lm")
    return np.concatenate([np.asarray(line), image])
