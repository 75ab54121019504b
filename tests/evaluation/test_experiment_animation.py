"""The animation of `experiments/openvima_small/animation.py`: what is shown, side by side, without end."""

import io

import numpy as np
import pytest
from PIL import Image, ImageSequence

from animation import SHOWN, Scenes, Wanted, compose, encoded, record_episode, tracks_of
from openvima.errors import ConfigError, OpenVimaError
from openvima.evaluation.results import EpisodeOutcome
from openvima.evaluation.rollout_policies import OracleRolloutPolicy

WIDTH = 200


def scenes(prompt, num_pictures: int) -> Scenes:
    pictures = [np.full((100, WIDTH, 3), 5 * k + num_pictures, np.uint8) for k in range(num_pictures)]
    return Scenes(Wanted("rotate", "L1", 0), prompt, pictures, EpisodeOutcome(0, True, 1))


def test_what_is_shown_by_default_exists() -> None:
    assert {Wanted.parse(text).level for text in SHOWN} == {"L1", "L2", "L3", "L4"}


@pytest.mark.parametrize("text", ["rotate", "rotate:L1:x", "rotat:L1", "rotate:L4"])
def test_what_cannot_be_shown_is_refused(text: str) -> None:
    with pytest.raises(OpenVimaError):
        Wanted.parse(text)


def test_tracks_are_about_equally_long_and_hold_every_episode() -> None:
    lengths = [120, 90, 80, 60, 50, 30]
    tracks = tracks_of(lengths, 3)
    assert sorted(k for track in tracks for k in track) == list(range(6))
    sums = [sum(lengths[k] for k in track) for track in tracks]
    assert max(sums) - min(sums) <= 30


def test_panels_move_until_all_of_them_end(prompt) -> None:
    frames = compose([scenes(prompt, n) for n in (12, 5, 4)], columns=2, rows=1, width=WIDTH)
    assert {frame.size for frame in frames} == {frames[0].size}
    assert frames[0].width == 2 * WIDTH + 10
    right = [frame.crop((WIDTH + 10, 0, 2 * WIDTH + 10, frame.height)).tobytes() for frame in frames]
    assert len(set(right)) == 5 + 4 + 2  # both of its episodes, each with its end


def test_an_animation_runs_without_end_and_equal_frames_are_stored_once() -> None:
    frames = [Image.new("RGB", (40, 20), (shade, 0, 0)) for shade in (0, 0, 0, 200)]
    with Image.open(io.BytesIO(encoded(frames, "WEBP", 80))) as film:
        assert (len(list(ImageSequence.Iterator(film))), film.info["loop"]) == (2, 0)


def test_an_episode_is_played_and_drawn() -> None:
    played = record_episode(OracleRolloutPolicy(), Wanted("rotate", "L1"), first_seed=0, width=WIDTH)
    assert played.outcome.success and played.wanted.seed is not None
    assert len(played.pictures) > 20
    assert {picture.shape for picture in played.pictures} == {(100, WIDTH, 3)}


class Idle:
    """Never does anything that helps."""

    def begin(self, envs) -> None: ...

    def decide(self, observations):
        turn = np.array([0, 0, 0, 1], np.float32)
        place = np.array([0.5, 0.0], np.float32)
        action = {
            "pose0_position": place,
            "pose0_rotation": turn,
            "pose1_position": place,
            "pose1_rotation": turn,
        }
        return [None if seen is None else action for seen in observations]

    def near_ties(self):
        return ()


def test_a_policy_that_solves_nothing_is_named_and_a_seed_shows_a_failure(monkeypatch) -> None:
    monkeypatch.setattr("animation.MAX_TRIES", 1)
    with pytest.raises(ConfigError, match="solves none of seeds 3 to 3"):
        record_episode(Idle(), Wanted("rotate", "L1"), first_seed=3, width=WIDTH)
    assert not record_episode(Idle(), Wanted("rotate", "L1", 3), first_seed=0, width=WIDTH).outcome.success
