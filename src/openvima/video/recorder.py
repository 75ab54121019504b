"""Recording an episode: the prompt as a strip, below it the front view with the arm, below it a caption."""

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.env.tabletop import TabletopEnv, VideoFrame
from openvima.render import channels_last
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Scene
from openvima.scene.explanation import Explanation
from openvima.sim.arm_view import arm_drawables
from openvima.sim.primitive_state import FRAMES_PER_SECOND
from openvima.sim.ur5 import HOME
from openvima.video.encoder import WriteFrame, open_video
from openvima.video.explanation import attention_rows, draw_panel
from openvima.video.prompt_strip import MUTED, PAPER, Colour, draw_prompt_strip, font

ENLARGE = 3  # 768 × 384 pixels
_STILL_START_S, _STILL_END_S = 0.8, 1.4  # time to read the prompt and the outcome
_STILL_DECISION_S = 1.5  # time to read an explanation
_GAP = 8  # pixels between scene and explanation
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
        return np.ascontiguousarray(channels_last(images["front"].rgb))


class EpisodeRecorder(ExitStack):
    """Records one episode of an environment in real time; a context manager.

    Args:
        env: An environment with `realtime`, reset to the episode.
        path: The MP4 file to write.
        title: Caption below the scene; no caption if empty.
        with_prompt: Whether to draw the prompt above the scene.
        explain: How the policy explains its last action; its explanation is drawn beside the scene, and
            attention below the prompt. None leaves both out.
    """

    def __init__(
        self,
        env: TabletopEnv,
        path: Path,
        *,
        title: str = "",
        with_prompt: bool = True,
        explain: Callable[[], Explanation] | None = None,
    ) -> None:
        super().__init__()
        self._renderer, self._title, self._width = SceneRenderer(env), title, 256 * ENLARGE
        self._path, self._explain = path, explain
        self._panel: np.ndarray | None = None
        self._strip = np.zeros((0, self._width, 3), np.uint8)
        self._write_frame: WriteFrame | None = None  # once the video is open
        self._last = VideoFrame(env.scene, HOME)
        if with_prompt:
            self._strip = draw_prompt_strip(env.prompt, width=self._width)
        if explain is None:  # else what the frames hold besides the scene follows from the first explanation
            self._start()

    def record_step(self, env: TabletopEnv) -> None:
        """Append the frames of the environment's last step, with an explanation after a still of it."""
        if self._explain is not None:
            explanation = self._explain()
            if self._write_frame is None:
                nothing = {kind: 0 * row for kind, row in explanation.attention.items()}
                self._draw_explanation(env, replace(explanation, attention=nothing), is_decided=False)
                self._start()
            self._draw_explanation(env, explanation)
            self._write(self._compose(), _STILL_DECISION_S)
        for self._last in env.frames:
            self._write(self._compose())

    def record_outcome(self, success: bool | None, steps: int) -> None:
        """Append a still of the last frame with the outcome in the caption; None: without goals."""
        taken = f"{steps} step{'' if steps == 1 else 's'}"
        outcome = taken if success is None else f"solved in {taken}" if success else "not solved"
        colour = MUTED if success is None else _GOOD if success else _BAD
        if self._write_frame is None:  # no step was taken that could be explained
            self._start()
        self._write(self._compose(outcome, colour), _STILL_END_S)

    def _compose(self, outcome: str = "", colour: Colour = MUTED) -> np.ndarray:
        scene = self._renderer.draw(self._last.scene, self._last.joints)
        shown = np.concatenate([scene, _caption(self._title, self._width, outcome, colour)])
        if self._panel is not None:
            shown = _beside(shown, self._panel)
        return np.concatenate([self._strip, shown])

    def _draw_explanation(
        self, env: TabletopEnv, explanation: Explanation, *, is_decided: bool = True
    ) -> None:
        """Draw the panel beside the scene, and the strip above both, with attention below the prompt."""
        self._panel = draw_panel(self._last.scene, env.assets, explanation if is_decided else None)
        weights = attention_rows(explanation)
        width = self._width + _GAP + self._panel.shape[1]
        self._strip = draw_prompt_strip(env.prompt, width=width, weights=weights)

    def _start(self) -> None:
        """Open the video, and write a still of the start."""
        first = self._compose()
        video = open_video(self._path, first.shape[1], first.shape[0], frames_per_second=FRAMES_PER_SECOND)
        self._write_frame = self.enter_context(video)
        self._write(first, _STILL_START_S)

    def _write(self, frame: np.ndarray, seconds: float = 0.0) -> None:
        assert self._write_frame is not None  # it was started
        self._write_frame(frame, repeat=max(1, math.ceil(seconds * FRAMES_PER_SECOND)))


def _beside(scene: np.ndarray, panel: np.ndarray) -> np.ndarray:
    """Put the panel right of the scene, both from the top, on white."""
    both = np.full((max(len(scene), len(panel)), scene.shape[1] + _GAP + panel.shape[1], 3), 255, np.uint8)
    both[: len(scene), : scene.shape[1]] = scene
    both[: len(panel), scene.shape[1] + _GAP :] = panel
    return both


def _caption(title: str, width: int, outcome: str, colour: Colour) -> np.ndarray:
    """Draw title and outcome in a line; without a title it has no height."""
    line = Image.new("RGB", (width, 32 if title else 0), PAPER)
    draw = ImageDraw.Draw(line)
    draw.text((11, 16), title, font=font(15), fill=MUTED, anchor="lm")
    if outcome:
        draw.text((width - 11, 16), outcome, font=font(15, bold=True), fill=colour, anchor="rm")
    return np.asarray(line)
