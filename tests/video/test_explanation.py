"""Explanations drawn beside a video."""

from pathlib import Path

import numpy as np
import pytest

from openvima.env import TabletopEnv
from openvima.errors import PolicyError
from openvima.evaluation.recording import record_episode
from openvima.evaluation.results import BAD_ACTION
from openvima.evaluation.rollout_policies import OracleRolloutPolicy, PromptedRolloutPolicy
from openvima.policies import RandomPolicy
from openvima.render import TOP, project
from openvima.scene import Action
from openvima.scene.explanation import Explanation, ObjectProbability, PlaceProbability
from openvima.video.explanation import ENLARGE, HEIGHT, PICK, PLACE, WIDTH, draw_panel
from openvima.video.prompt_strip import draw_prompt_strip
from openvima.video.recorder import EpisodeRecorder, SceneRenderer
from small_data_sets import frames_of


@pytest.fixture
def env() -> TabletopEnv:
    env = TabletopEnv("visual_manipulation", realtime=True)
    env.reset(seed=0)
    return env


def boxed(env: TabletopEnv, object_id: int, probability: float) -> ObjectProbability:
    position = env.scene[object_id].pose.position
    column, row = np.rint(project(np.array(position), TOP)).astype(int).tolist()
    return ObjectProbability(object_id, {"top": (column, row, 20, 20)}, tuple(position[:2]), probability)


def pointing(env: TabletopEnv) -> Explanation:
    """Nearly sure of one object, and of a place at the far edge of the table."""
    first, second = (placement.id for placement in env.scene.placements[:2])
    place = PlaceProbability("grid", (0.4, -0.4), 1.0)
    action = Action.planar(env.scene[first].pose.position[:2], place.position).to_arrays()
    words = ("Put", "the", "{a}", "into", "the", "{b}", ".", "")
    attention = {"pick": np.eye(8)[2], "place": np.eye(8)[5]}
    yaw = np.linspace(-np.pi, np.pi, 8, endpoint=False)
    objects = (boxed(env, first, 0.9), boxed(env, second, 0.1))
    return Explanation(action, words, attention, objects, (place,), yaw, np.eye(8)[4])


def over_bins(env: TabletopEnv) -> Explanation:
    """Sure of one cell of the table for each pose."""
    action = Action.planar((0.5, 0.3), (0.5, -0.3)).to_arrays()  # elsewhere, as its arrow hides what is below
    bins = {}
    for pose, at in (("pose0", (5, 10)), ("pose1", (45, 90))):
        bins |= {
            f"{pose}_position.{axis}": np.eye(n)[k] for axis, n, k in zip("xy", (50, 100), at, strict=True)
        }
        bins |= {f"{pose}_rotation.{axis}": np.full(50, 0.02) for axis in "xyzw"}
    return Explanation(action, ("Wait.", ""), {"decoder": np.full(2, 0.5)}, bins=bins)


def pixels_like(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return (np.abs(image.astype(int) - colour) < 40).all(axis=2)


def test_the_panel_colours_the_object_and_marks_the_place(env) -> None:
    explanation = pointing(env)
    plain = draw_panel(env.scene, env.assets, None)
    panel = draw_panel(env.scene, env.assets, explanation)
    assert panel.shape == plain.shape == (HEIGHT, WIDTH, 3)
    table = panel[: 128 * ENLARGE]
    column, row, *_ = (ENLARGE * value for value in explanation.objects[0].boxes["top"])
    near = (slice(max(row - 30, 0), row + 30), slice(max(column - 30, 0), column + 30))
    assert pixels_like(table[near], PICK).sum() > 4 * pixels_like(plain[near], PICK).sum() + 50
    column, row = (ENLARGE * project(np.array([0.4, -0.4, 0.0]), TOP)).astype(int)
    assert pixels_like(table[row - 14 : row + 14, column - 14 : column + 14], PLACE).sum() > 60


def test_the_panel_of_bins_colours_both_cells(env) -> None:
    explanation = over_bins(env)
    panel = draw_panel(env.scene, env.assets, explanation).astype(int)
    plain = draw_panel(env.scene, env.assets, None).astype(int)
    for pose, (x, y), channel in (("pose0", (0.305, -0.395), 0), ("pose1", (0.705, 0.405), 2)):
        heat = explanation.heat_map(pose)
        assert heat.max() == 1 and heat.shape == (50, 100)
        column, row = (ENLARGE * project(np.array([x, y, 0.0]), TOP)).round().astype(int)
        change = (panel - plain)[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).mean(axis=0)
        assert change.argmax() == channel and change[channel] > 60


def test_attention_is_drawn_below_its_word_or_image(prompt) -> None:
    weights = np.eye(8)[2]  # all on the first image
    plain = draw_prompt_strip(prompt, width=768)
    strip = draw_prompt_strip(prompt, width=768, weights=[(PICK, weights[:-1])])
    assert strip.shape[0] > plain.shape[0] and strip.shape[1] == 768
    columns = np.flatnonzero((strip == PICK).all(axis=2).any(axis=0))
    image = np.flatnonzero((plain == (0, 200, 0)).all(axis=2).any(axis=0))
    assert abs(columns.mean() - image.mean()) < 4
    assert np.array_equal(draw_prompt_strip(prompt, width=768, weights=()), plain)


def test_the_video_of_an_explained_episode_has_the_panel_beside_the_scene(tmp_path: Path) -> None:
    env = TabletopEnv("visual_manipulation")  # without frames: stills alone
    env.reset(seed=0)
    explanation = pointing(env)
    start = SceneRenderer(env).draw(env.scene).astype(int)
    with EpisodeRecorder(env, tmp_path / "video.mp4", explain=lambda: explanation) as recorder:
        recorder.record_step(env)
    frames = frames_of(tmp_path / "video.mp4")
    assert frames[0].shape[1] == 768 + 8 + WIDTH
    bottom = frames[-1][-HEIGHT:].astype(int)
    assert np.abs(bottom[: len(start), :768] - start).mean() < 4
    panel = draw_panel(env.scene, env.assets, explanation).astype(int)
    assert np.abs(bottom[:, 776:] - panel).mean() < 4


@pytest.mark.parametrize("policy", [OracleRolloutPolicy(), PromptedRolloutPolicy(RandomPolicy())])
def test_a_policy_without_explanations_is_refused_before_it_acts(env, policy, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"no explain.*openvima-small.*all presets"):
        record_episode(env, policy, 0, tmp_path / "video.mp4", explain=True)
    assert not list(tmp_path.iterdir())


def test_an_explained_episode_without_a_step_has_a_video_of_its_start(tmp_path: Path) -> None:
    class Wrong(RandomPolicy):
        def act(self, observations):
            nowhere = {"pose0_position": np.full(2, np.nan, np.float32)}
            return [action | nowhere for action in super().act(observations)]

        def explain(self):
            raise AssertionError("there is nothing to explain")

    env = TabletopEnv("visual_manipulation", realtime=True)
    path = tmp_path / "video.mp4"
    outcome = record_episode(env, PromptedRolloutPolicy(Wrong()), 0, path, title="rotate", explain=True)
    assert (outcome.kind, outcome.steps) == (BAD_ACTION, 0)
    assert frames_of(path)[0].shape[1] == 768


def test_words_stand_below_the_table_with_their_points(env: TabletopEnv) -> None:
    action = Action.planar((0.5, 0.3), (0.5, -0.3)).to_arrays()
    said = "I see it there.\x1b[2J\n" + "and so on " * 200 + '\n{"pick": [800, 500], "place": [200, 500]}'
    panel = draw_panel(env.scene, env.assets, Explanation(action, (), {}, words=said))
    assert panel.shape == (HEIGHT, WIDTH, 3)
    for pose, colour in (("pose0", PICK), ("pose1", PLACE)):
        x, y = np.rint(ENLARGE * project(np.array([*action[f"{pose}_position"], 0.0]), TOP)).astype(int)
        near = panel[y - 8 : y + 8, x - 8 : x + 8].reshape(-1, 3)
        assert (near == colour).all(axis=1).any()
    assert (panel[TOP.height * ENLARGE + 140 :, :] < 128).any()  # the last line, which holds the points
