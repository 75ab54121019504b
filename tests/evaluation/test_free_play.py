"""Playing single episodes: results, policies of all kinds, and recordings."""

from pathlib import Path

import numpy as np
import pytest

from openvima import compose
from openvima.cli.main import main
from openvima.env import save_episode
from openvima.errors import ConfigError, OracleError, PolicyError, UnknownPolicyError
from openvima.evaluation import play
from openvima.policies import RandomPolicy
from openvima.scene import Action

OBJECTS = [("block", "red", (0.5, -0.2)), ("bowl", "green", (0.5, 0.2))]
PROMPT = "Put the {a} into the {b}."


class FirstIntoSecond:
    """Picks at (0.5, -0.2) and places at (0.5, 0.2)."""

    def reset(self, prompts):
        self.prompts = prompts

    def act(self, observations):
        return [Action.planar((0.5, -0.2), (0.5, 0.2), 0.0).to_arrays() for _ in observations]


class NoAction(FirstIntoSecond):
    """Gives an action outside the workspace."""

    def act(self, observations):
        (action,) = super().act(observations)
        return [action | {"pose0_position": np.float32([9, 9])}]


def test_an_object_and_the_oracle_solve_a_composed_episode() -> None:
    episode = compose(OBJECTS, PROMPT, goals=[("in", "a", "b")])
    for policy in (FirstIntoSecond(), "oracle"):
        result = play(episode, policy, frames=True)
        assert result.outcome.success and result.steps == len(result.actions) == 1
        assert [frame.shape for frame in result.frames] == [(256, 256, 3)] * 2
        assert result.scene[5].pose.planar_distance(episode.problem.scene[6].pose) < 0.1


def test_without_goals_the_step_limit_ends_the_episode() -> None:
    result = play(compose(OBJECTS, PROMPT, max_steps=2), FirstIntoSecond())
    assert result.steps == 2 and not result.outcome.is_over
    assert result.outcome.reason == "the step limit is reached; the episode has no goals"
    with pytest.raises(OracleError, match="no goals"):
        play(compose(OBJECTS, PROMPT), "oracle", video="never_written.mp4")


def test_an_invalid_action_ends_the_episode_with_its_message() -> None:
    result = play(compose(OBJECTS, PROMPT), NoAction())
    assert result.steps == 0 and "pose0_position is (9" in result.outcome.reason


def test_policies_by_name_and_what_is_none() -> None:
    episode = compose(OBJECTS, PROMPT, max_steps=1)
    assert play(episode, "random").steps == play(episode, RandomPolicy()).steps == 1
    with pytest.raises(UnknownPolicyError):
        play(episode, "no-such-policy")
    with pytest.raises(PolicyError, match="policy is a int without reset and act"):
        play(episode, 3)  # type: ignore[arg-type]  # wrong on purpose


def test_an_episode_is_played_from_its_file(tmp_path: Path) -> None:
    episode = compose(OBJECTS, PROMPT, goals=[("in", "a", "b")])
    save_episode(episode, tmp_path / "scene.json")
    assert play(tmp_path / "scene.json", FirstIntoSecond()) == play(episode, FirstIntoSecond())
    with pytest.raises(ConfigError, match=r"video is 'a\.avi'; videos are MP4 files"):
        play(episode, "oracle", video="a.avi")


@pytest.mark.slow
def test_demo_records_an_episode_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("av")
    scene = save_episode(compose(OBJECTS, PROMPT, goals=[("in", "a", "b")]), tmp_path / "scene.yaml")
    assert main(["demo", "--episode", str(scene), "--out", str(tmp_path / "x.mp4")]) == 0
    assert "by oracle: solved; 1 step" in capsys.readouterr().out
    assert (tmp_path / "x.mp4").stat().st_size > 1000


def test_demo_takes_a_task_or_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo"]) == 2 and main(["demo", "rotate", "--episode", "x.yaml"]) == 2
    assert "either a TASK or --episode FILE" in capsys.readouterr().err
    assert main(["demo", "--episode", "x.yaml", "--seed", "3"]) == 2
    assert "leave them out" in capsys.readouterr().err
    assert main(["demo", "--episode", "missing.yaml"]) == 2
    assert "missing.yaml" in capsys.readouterr().err


@pytest.mark.parametrize("returned", [["because"], None])
def test_an_explanation_of_another_kind_is_refused(returned: object, tmp_path: Path) -> None:
    pytest.importorskip("av")
    policy = FirstIntoSecond()
    policy.explain = lambda: returned  # type: ignore[attr-defined]
    with pytest.raises(PolicyError, match=r"explain\(\) of .* returned .*; give a list of an Explanation"):
        play(compose(OBJECTS, PROMPT), policy, video=tmp_path / "a.mp4", explain=True)
    assert not list(tmp_path.glob("*.mp4"))
