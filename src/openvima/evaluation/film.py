"""Filming episodes: the front view with the arm at work, below the prompt as a strip."""

import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.env.tabletop import FRAMES_PER_SECOND, Frame, TabletopEnv
from openvima.evaluation.prompt_strip import draw_prompt_strip, font
from openvima.evaluation.results import EpisodeOutcome
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import RolloutPolicy
from openvima.evaluation.video import VideoWriter
from openvima.render import channels_last
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Scene
from openvima.sim.arm_view import arm_drawables
from openvima.sim.ur5 import HOME

ENLARGE = 3  # 768 × 384 pixels
_STILL_START_S, _STILL_END_S = 0.8, 1.4  # s; time to read the prompt, and to see how it ended
_GOOD, _BAD = (24, 121, 78), (180, 35, 24)


class SceneRenderer:
    """Draws the moments of an episode, larger and sharper than a policy sees them, and with the arm.

    Args:
        env: The environment whose episodes are drawn.
        enlarge: Factor on the benchmark's images of 128 × 256 pixels.
    """

    def __init__(self, env: TabletopEnv, enlarge: int = ENLARGE) -> None:
        self._rasteriser = Rasteriser(env.assets)
        self._enlarge = enlarge

    def draw(self, scene: Scene, joints: np.ndarray | None = HOME) -> np.ndarray:
        """Draw the front view.

        Args:
            scene: Where the objects are.
            joints: Angles of the arm, shape (6,), radians; None leaves the arm out.

        Returns:
            Shape (128 · enlarge, 256 · enlarge, 3), uint8.
        """
        arm = () if joints is None else arm_drawables(joints, scene.end_effector)
        images = self._rasteriser.scene(scene, views=("front",), extra=arm, enlarge=self._enlarge)
        return np.ascontiguousarray(channels_last(images["front"].rgb))


def record_episode(
    env: TabletopEnv,
    player: RolloutPolicy,
    seed: int,
    path: Path,
    *,
    title: str = "",
    with_prompt: bool = True,
    enlarge: int = ENLARGE,
) -> EpisodeOutcome:
    """Play one episode and film it in real time.

    Args:
        env: An environment with `realtime`.
        player: Who decides.
        seed: The episode's seed.
        path: The MP4 file to write.
        title: What stands in the line below the scene; no line where it is empty.
        with_prompt: Whether the prompt stands above the scene.
        enlarge: Factor on the benchmark's images.

    Returns:
        How the episode ended.
    """
    artist = SceneRenderer(env, enlarge)
    env.reset(seed=seed)
    strip = draw_prompt_strip(env.prompt, width=256 * enlarge) if with_prompt else None
    last = Frame(env.scene, HOME)
    first = _composed(strip, artist.draw(last.scene, last.joints), _caption(title, None, 256 * enlarge))
    with VideoWriter(path, first.shape[1], first.shape[0], frames_per_second=FRAMES_PER_SECOND) as film:
        film.write(first, times=math.ceil(_STILL_START_S * FRAMES_PER_SECOND))

        def record(env: TabletopEnv) -> None:
            nonlocal last
            for last in env.frames:
                picture = artist.draw(last.scene, last.joints)
                film.write(_composed(strip, picture, _caption(title, None, picture.shape[1])))

        (outcome,) = play([env], [seed], player, after_step=record)
        picture = artist.draw(last.scene, last.joints)
        film.write(
            _composed(strip, picture, _caption(title, outcome, picture.shape[1])),
            times=math.ceil(_STILL_END_S * FRAMES_PER_SECOND),
        )
    return outcome


def _composed(strip: np.ndarray | None, picture: np.ndarray, caption: np.ndarray | None) -> np.ndarray:
    return np.concatenate([part for part in (strip, picture, caption) if part is not None])


def _caption(title: str, outcome: EpisodeOutcome | None, width: int) -> np.ndarray | None:
    """Draw the line below the scene: what is played and, at the end, how it ended."""
    if not title:
        return None
    line = Image.new("RGB", (width, 32), (255, 255, 255))
    draw = ImageDraw.Draw(line)
    draw.text((11, 16), title, font=font(15), fill=(91, 100, 114), anchor="lm")
    if outcome is not None:
        steps = "1 step" if outcome.steps == 1 else f"{outcome.steps} steps"
        text = f"solved in {steps}" if outcome.success else "not solved"
        colour = _GOOD if outcome.success else _BAD
        draw.text((width - 11, 16), text, font=font(15, bold=True), fill=colour, anchor="rm")
    return np.asarray(line)
