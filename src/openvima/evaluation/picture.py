"""A still picture of one episode: the prompt, the start and the end."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.atomic_io import atomic_write_file
from openvima.env.tabletop import TabletopEnv
from openvima.evaluation.clips import png
from openvima.evaluation.film import SceneRenderer
from openvima.evaluation.prompt_strip import draw_prompt_strip, font
from openvima.evaluation.results import EpisodeOutcome
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import OracleRolloutPolicy, RolloutPolicy

_GAP = 12  # pixels between the parts
_MUTED = (91, 100, 114)


def save_episode_image(
    env: TabletopEnv, path: Path, *, seed: int, player: RolloutPolicy | None = None, enlarge: int = 2
) -> EpisodeOutcome:
    """Play one episode and draw it: the prompt above, the table before and after side by side.

    Args:
        env: The environment to play in.
        path: The PNG file to write.
        seed: The episode's seed.
        player: Who decides; by default the oracle.
        enlarge: Factor on the benchmark's images of 128 × 256 pixels.

    Returns:
        How the episode ended.
    """
    artist = SceneRenderer(env, enlarge)
    env.reset(seed=seed)
    start = artist.draw(env.scene, joints=None)
    (outcome,) = play([env], [seed], player or OracleRolloutPolicy())
    end = artist.draw(env.scene, joints=None)
    ended = "after: solved" if outcome.success else "after: not solved"
    scenes = _beside(_titled(start, "before"), _titled(end, ended))
    strip = draw_prompt_strip(env.prompt, width=scenes.shape[1])
    picture = np.concatenate([strip, scenes, np.full((_GAP, scenes.shape[1], 3), 255, np.uint8)])
    atomic_write_file(path, png(Image.fromarray(picture)))
    return outcome


def _titled(picture: np.ndarray, title: str) -> np.ndarray:
    line = Image.new("RGB", (picture.shape[1], 26), (255, 255, 255))
    ImageDraw.Draw(line).text((0, 13), title, font=font(14), fill=_MUTED, anchor="lm")
    return np.concatenate([np.asarray(line), picture])


def _beside(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    gap = np.full((left.shape[0], _GAP, 3), 255, np.uint8)
    return np.concatenate([gap, left, gap, right, gap], axis=1)
