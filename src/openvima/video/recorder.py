"""Recording an episode: the prompt as a strip, below it the front view with the arm, below it a caption."""

import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.env.tabletop import FRAMES_PER_SECOND, TabletopEnv, VideoFrame
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Scene
from openvima.sim.arm_view import arm_drawables
from openvima.sim.ur5 import HOME
from openvima.video.encoder import VideoWriter
from openvima.video.prompt_strip import MUTED, PAPER, Colour, draw_prompt_strip, font

ENLARGE = 3  # 768 × 384 pixels
_STILL_START_S, _STILL_END_S = 0.8, 1.4  # time to read the prompt and the outcome
_GOOD, _BAD = (24, 121, 78), (180, 35, 24)


class SceneRenderer:
    """Renders the front view with the arm, at a higher resolution than observations.

    Args:
        env: The environment whose episodes are rendered.
        enlarge: Factor on the benchmark's images of 128 × 256 pixels.
    """

    def __init__(self, env: TabletopEnv, enlarge: int = ENLARGE) -> None:
        self._rasteriser = Rasteriser(env.assets)
        self._enlarge = enlarge

    def draw(self, scene: Scene, joints: np.ndarray | None = HOME) -> np.ndarray:
        """Render a scene.

        Args:
            scene: Where the objects are.
            joints: Joint angles of the arm, shape (6,), radians; None leaves the arm out.

        Returns:
            Shape (128 · enlarge, 256 · enlarge, 3), uint8.
        """
        arm = () if joints is None else arm_drawables(joints, scene.end_effector)
        images = self._rasteriser.scene(scene, views=("front",), extra=arm, enlarge=self._enlarge)
        return np.ascontiguousarray(np.moveaxis(images["front"].rgb, 0, -1))


class EpisodeRecorder:
    """Records one episode of an environment in real time; a context manager.

    Args:
        env: An environment with `realtime`, reset to the episode.
        path: The MP4 file to write.
        title: Caption below the scene; no caption if empty.
        with_prompt: Whether to draw the prompt above the scene.
        enlarge: Factor on the benchmark's images.
    """

    def __init__(
        self,
        env: TabletopEnv,
        path: Path,
        *,
        title: str = "",
        with_prompt: bool = True,
        enlarge: int = ENLARGE,
    ) -> None:
        self._renderer, self._title, self._width = SceneRenderer(env, enlarge), title, 256 * enlarge
        self._strip = draw_prompt_strip(env.prompt, width=self._width) if with_prompt else None
        self._last = VideoFrame(env.scene, HOME)
        first = self._compose(_caption(title, self._width))
        self._video = VideoWriter(path, first.shape[1], first.shape[0], frames_per_second=FRAMES_PER_SECOND)
        self._video.write(first, repeat=math.ceil(_STILL_START_S * FRAMES_PER_SECOND))

    def record_step(self, env: TabletopEnv) -> None:
        """Append the frames of the environment's last step."""
        for self._last in env.frames:
            self._video.write(self._compose(_caption(self._title, self._width)))

    def record_outcome(self, success: bool | None, steps: int) -> None:
        """Append a still of the last frame with the outcome in the caption; None: without goals."""
        taken = f"{steps} step{'' if steps == 1 else 's'}"
        outcome = taken if success is None else f"solved in {taken}" if success else "not solved"
        colour = MUTED if success is None else _GOOD if success else _BAD
        caption = _caption(self._title, self._width, outcome, colour)
        self._video.write(self._compose(caption), repeat=math.ceil(_STILL_END_S * FRAMES_PER_SECOND))

    def _compose(self, caption: np.ndarray | None) -> np.ndarray:
        scene = self._renderer.draw(self._last.scene, self._last.joints)
        return np.concatenate([part for part in (self._strip, scene, caption) if part is not None])

    def __enter__(self) -> "EpisodeRecorder":
        return self

    def __exit__(self, *exception) -> None:
        self._video.__exit__(*exception)


def _caption(title: str, width: int, outcome: str = "", colour: Colour = MUTED) -> np.ndarray | None:
    if not title:
        return None
    line = Image.new("RGB", (width, 32), PAPER)
    draw = ImageDraw.Draw(line)
    draw.text((11, 16), title, font=font(15), fill=MUTED, anchor="lm")
    if outcome:
        draw.text((width - 11, 16), outcome, font=font(15, bold=True), fill=colour, anchor="rm")
    return np.asarray(line)
