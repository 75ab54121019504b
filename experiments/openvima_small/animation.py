"""Make docs/images/openvima_small.webp: rollouts of several tasks, side by side, with their prompts.

    python experiments/openvima_small/animation.py [--policy NAME] [--show TASK:LEVEL,...] [--out FILE]

Each task shows the first solved episode from `--seed` on (domain "user", neither training nor evaluation);
TASK:LEVEL:SEED selects an episode, solved or not. All shown episodes are printed. Panels play their episodes
in sequence, in real time, and end together. For videos of single episodes, failures included, see `openvima
demo` and the report of `openvima evaluate`.
"""

import argparse
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.atomic_io import atomic_write_file
from openvima.env import EnvConfig
from openvima.env.running_episode import FRAMES_PER_SECOND
from openvima.env.tabletop import TabletopEnv, VideoFrame
from openvima.errors import ConfigError, OpenVimaError
from openvima.evaluation.config import Batch
from openvima.evaluation.results import EpisodeOutcome
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import RolloutPolicy, load_rollout_policy
from openvima.scene import RenderedPrompt
from openvima.sim.ur5 import HOME
from openvima.tasks import task_spec
from openvima.video.prompt_strip import draw_prompt_strip, font
from openvima.video.recorder import SceneRenderer

OUT = Path("docs/images/openvima_small.webp")
SHOWN = (  # every level; object and scene images, words, rotations, sequences; prompts of two lines
    "rearrange_then_restore:L1",
    "pick_in_order_then_restore:L2",
    "follow_order:L3",
    "same_texture:L4",
    "rotate:L3",
    "scene_understanding:L3",
)
STRIDE = 2  # of 30 frames a second; every second one is smooth enough
START_S, END_S = 1.2, 1.0  # s; pauses before and after an episode
ENLARGE = 3  # supersampling of panels, for smooth edges
GAP, TITLE_PX, ROUND_PX = 10, 30, 8
PAPER, INK, MUTED, EDGE, GOOD, BAD = "#ffffff", "#1f2933", "#5b6472", "#d0d5dc", "#18794e", "#b42318"
MAX_TRIES = 50


@dataclass(frozen=True, slots=True)
class Wanted:
    """An episode to show.

    Args:
        task: Name of the task.
        level: Its level.
        seed: The episode's seed; None for the first that is solved.
    """

    task: str
    level: str
    seed: int | None = None

    @staticmethod
    def parse(text: str) -> "Wanted":
        """Read TASK:LEVEL or TASK:LEVEL:SEED.

        Raises:
            ConfigError: It is neither.
            OpenVimaError: There is no such task, or it has no such level.
        """
        task, _, rest = text.partition(":")
        level, _, seed = rest.partition(":")
        if not level or (seed and not seed.isdecimal()):
            raise ConfigError(f"--show has {text!r}; each entry is TASK:LEVEL or TASK:LEVEL:SEED.")
        return Wanted(task, task_spec(task).checked_level(level), int(seed) if seed else None)


@dataclass(frozen=True, slots=True, eq=False)
class Scenes:
    """A recorded episode.

    Args:
        wanted: The requested episode, with its seed.
        prompt: The prompt.
        pictures: The front view, each of shape (height, width, 3), uint8.
        outcome: The outcome.
    """

    wanted: Wanted
    prompt: RenderedPrompt
    pictures: list[np.ndarray]
    outcome: EpisodeOutcome


def record_episode(policy: RolloutPolicy, wanted: Wanted, *, first_seed: int, width: int) -> Scenes:
    """Roll out and render one episode.

    Args:
        policy: The policy.
        wanted: The episode.
        first_seed: First seed of the search for a solved episode.
        width: Of the pictures in pixels.

    Raises:
        ConfigError: The policy solves none of the first 50.
    """
    env = EnvConfig().make(wanted.task, wanted.level, domain="user", realtime=True)
    artist = SceneRenderer(env, ENLARGE)
    seeds = [wanted.seed] if wanted.seed is not None else range(first_seed, first_seed + MAX_TRIES)
    for seed in seeds:
        env.reset(seed=seed)
        frames = [VideoFrame(env.scene, HOME)]

        def record(env: TabletopEnv, frames: list[VideoFrame] = frames) -> None:
            frames += env.frames

        (outcome,) = play([env], [seed], policy, after_step=record)
        if outcome.success or wanted.seed is not None:
            chosen = [*frames[:-1:STRIDE], frames[-1]]
            pictures = [scaled(artist.draw(frame.scene, frame.joints), width) for frame in chosen]
            return Scenes(Wanted(wanted.task, wanted.level, seed), env.prompt, pictures, outcome)
    raise ConfigError(
        f"of {wanted.task} at {wanted.level} the policy solves none of seeds {seeds[0]} to {seeds[-1]}; "
        "leave the task out of --show, or name a seed."
    )


def scaled(picture: np.ndarray, width: int) -> np.ndarray:
    """Scale a picture to a width."""
    height = round(len(picture) * width / picture.shape[1])
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.LANCZOS))


def tracks_of(lengths: Sequence[int], num_tracks: int) -> list[list[int]]:
    """Spread episodes over tracks that end at about the same time.

    Args:
        lengths: Frames of each episode.
        num_tracks: Number of tracks, at most as many as episodes.

    Returns:
        For each track the numbers of its episodes, ascending.
    """
    tracks: list[list[int]] = [[] for _ in range(num_tracks)]
    for number in sorted(range(len(lengths)), key=lambda k: (-lengths[k], k)):  # the longest first
        min(tracks, key=lambda track: sum(lengths[k] for k in track)).append(number)
    return sorted(sorted(track) for track in tracks)


def panels_of(scenes: Scenes, *, width: int, head_px: int, still: tuple[int, int]) -> list[Image.Image]:
    """Draw an episode as panels: title, prompt and scene; `still` frames of rest at start and end."""
    strip = prompt_strip(scenes.prompt, width)
    before, after = (_panel(scenes, strip, head_px, width, done=done) for done in (False, True))
    top = TITLE_PX + head_px

    def with_scene(panel: Image.Image, picture: np.ndarray) -> Image.Image:
        panel = panel.copy()
        panel.paste(Image.fromarray(picture), (0, top))
        return _rounded(panel)

    moving = [with_scene(before, picture) for picture in scenes.pictures]
    return [moving[0]] * still[0] + moving + [with_scene(after, scenes.pictures[-1])] * still[1]


def prompt_strip(prompt: RenderedPrompt, width: int) -> np.ndarray:
    """Draw a prompt as wide as a panel."""
    return draw_prompt_strip(prompt, width=width, image_height=42, font_size=16)


def _panel(scenes: Scenes, strip: np.ndarray, head_px: int, width: int, *, done: bool) -> Image.Image:
    height = TITLE_PX + head_px + len(scenes.pictures[0])
    panel = Image.new("RGB", (width, height), PAPER)
    draw, middle = ImageDraw.Draw(panel), TITLE_PX // 2 + 3
    name = scenes.wanted.task.replace("_", " ")
    draw.text((10, middle), f"{name} · {scenes.wanted.level}", font=font(14), fill=MUTED, anchor="lm")
    if done:
        text, colour = ("✓ solved", GOOD) if scenes.outcome.success else ("not solved", BAD)
        draw.text((width - 10, middle), text, font=font(14, bold=True), fill=colour, anchor="rm")
    panel.paste(Image.fromarray(strip), (0, TITLE_PX + (head_px - len(strip)) // 2))
    return panel


def _rounded(panel: Image.Image) -> Image.Image:
    """Give a panel round corners and an edge."""
    scale = 4  # drawn larger and scaled down for a smooth edge
    size = (panel.width * scale, panel.height * scale)
    mask, edge = Image.new("L", size, 0), Image.new("L", size, 0)
    box, radius = (0, 0, size[0] - 1, size[1] - 1), ROUND_PX * scale
    ImageDraw.Draw(mask).rounded_rectangle(box, radius, fill=255)
    ImageDraw.Draw(edge).rounded_rectangle(box, radius, outline=255, width=scale)
    whole = Image.new("RGB", panel.size, PAPER)
    whole.paste(panel, mask=mask.resize(panel.size, Image.Resampling.BOX))
    whole.paste(EDGE, mask=edge.resize(panel.size, Image.Resampling.BOX))
    return whole


def compose(played: Sequence[Scenes], *, columns: int, rows: int, width: int) -> list[Image.Image]:
    """Put episodes side by side.

    Args:
        played: The episodes.
        columns: Panels in a row.
        rows: Rows of panels.
        width: Of a panel in pixels; that of the pictures.

    Returns:
        The frames.
    """
    still = tuple(round(seconds * FRAMES_PER_SECOND / STRIDE) for seconds in (START_S, END_S))
    lengths = [len(scenes.pictures) + sum(still) for scenes in played]
    tracks = tracks_of(lengths, columns * rows)
    total = max(sum(lengths[k] for k in track) for track in tracks)
    track_frames = []
    for number, track in enumerate(tracks):
        of_row = [k for other in tracks[number // columns * columns :][:columns] for k in other]
        head_px = max(len(prompt_strip(played[k].prompt, width)) for k in of_row)
        spare = total - sum(lengths[k] for k in track)
        panels: list[Image.Image] = []
        for place, k in enumerate(track):  # what a track lacks in length it rests, before and after
            share = spare // len(track) + (place < spare % len(track))
            rest = (still[0] + share // 3, still[1] + share - share // 3)
            panels += panels_of(played[k], width=width, head_px=head_px, still=rest)
        track_frames.append(panels)
    return [_beside([panels[time] for panels in track_frames], columns) for time in range(total)]


def _beside(panels: Sequence[Image.Image], columns: int) -> Image.Image:
    rows = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    height = sum(row[0].height for row in rows) + GAP * (len(rows) - 1)
    whole = Image.new("RGB", (panels[0].width * columns + GAP * (columns - 1), height), PAPER)
    top = 0
    for row in rows:
        for column, panel in enumerate(row):
            whole.paste(panel, (column * (panel.width + GAP), top))
        top += row[0].height + GAP
    return whole


def encoded(frames: Sequence[Image.Image], kind: str, quality: int) -> bytes:
    """Encode frames as an animation without end.

    Args:
        frames: Its pictures.
        kind: "WEBP", "PNG" or "GIF".
        quality: Of WEBP, 0 to 100; the others lose nothing but colours.
    """
    durations, kept = [], []  # equal frames become one that stands longer
    for frame in frames:
        if kept and frame.tobytes() == kept[-1].tobytes():
            durations[-1] += 1
        else:
            kept.append(frame)
            durations.append(1)
    milliseconds = [round(1000 * STRIDE * count / FRAMES_PER_SECOND) for count in durations]
    options = {"quality": quality, "method": 4, "minimize_size": False} if kind == "WEBP" else {}
    stream = io.BytesIO()
    first, *others = kept
    first.save(stream, kind, save_all=True, append_images=others, duration=milliseconds, loop=0, **options)
    return stream.getvalue()


def main() -> None:
    """Run the episodes, and write the animation."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--policy", default="openvima-small", help="policy, as in `openvima demo`")
    parser.add_argument("--show", default=",".join(SHOWN), help="episodes, TASK:LEVEL or TASK:LEVEL:SEED")
    parser.add_argument("--seed", type=int, default=0, help="first seed to try")
    parser.add_argument("--columns", type=int, default=2, help="panels per row")
    parser.add_argument("--rows", type=int, default=2, help="rows of panels")
    parser.add_argument("--width", type=int, default=810, help="width of the animation in pixels")
    parser.add_argument("--quality", type=int, default=50, help="quality of a .webp, 0 to 100")
    parser.add_argument("--out", type=Path, default=OUT, help=".webp, .png (APNG) or .gif")
    options = parser.parse_args()
    kind = {".webp": "WEBP", ".png": "PNG", ".gif": "GIF"}.get(options.out.suffix.lower())
    if kind is None:
        parser.error(f"--out is {str(options.out)!r}; the name must end in .webp, .png or .gif.")
    try:
        wanted = [Wanted.parse(text) for text in options.show.split(",")]
        if not 1 <= options.columns * options.rows <= len(wanted):
            raise ConfigError(
                f"{options.columns} × {options.rows} panels for {len(wanted)} episodes; each needs one."
            )
        width = (options.width - GAP * (options.columns - 1)) // options.columns
        first = wanted[0]
        batch = Batch(
            options.policy,
            options.policy,
            first.task,
            first.level,
            first_seed=0,
            episodes=1,
            env_config=EnvConfig(),
        )
        policy = load_rollout_policy(batch)
        played = [record_episode(policy, entry, first_seed=options.seed, width=width) for entry in wanted]
    except OpenVimaError as error:
        parser.error(str(error))
    frames = compose(played, columns=options.columns, rows=options.rows, width=width)
    content = encoded(frames, kind, options.quality)
    atomic_write_file(options.out, content)
    for scenes in played:
        ended = f"solved in {scenes.outcome.steps}" if scenes.outcome.success else scenes.outcome.reason
        print(f"{scenes.wanted.task}:{scenes.wanted.level}:{scenes.wanted.seed}  {ended}")
    seconds = len(frames) * STRIDE / FRAMES_PER_SECOND
    print(
        f"{options.out}: {seconds:.1f} s, {frames[0].width} × {frames[0].height}, {len(content) / 1e6:.2f} MB"
    )


if __name__ == "__main__":
    main()
