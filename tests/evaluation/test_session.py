"""Sessions: stepping, going back, errors of policies as values, and comparing two runs."""

from pathlib import Path

import numpy as np
import pytest

from openvima.catalog import load_assets
from openvima.env.episode_file import load_episode, save_episode
from openvima.errors import ActionError, EpisodeError
from openvima.evaluation.rollout_policies import OracleRolloutPolicy, load_own_rollout_policy
from openvima.evaluation.session import EpisodeSession, first_difference, play
from openvima.policies import RandomPolicy
from openvima.policies.naming import SMALL
from openvima.scene import Action
from openvima.studio.composition import Composition
from openvima.tasks import sample_episode

EPISODE = sample_episode("rearrange", seed=0)  # the oracle takes two steps


def actions(session: EpisodeSession) -> list[Action]:
    return [step.action for step in session.steps]


def test_a_session_ends_as_a_rollout_does() -> None:
    session = EpisodeSession(EPISODE, OracleRolloutPolicy())
    outcome = session.run()
    played = play(EPISODE, "oracle")
    assert outcome is not None and outcome.success == played.outcome.success
    assert actions(session) == list(played.actions)
    assert session.scene == played.scene
    with pytest.raises(EpisodeError, match="ended at step 2"):
        session.step()


def test_going_back_and_on_gives_the_same_steps() -> None:
    session = EpisodeSession(EPISODE, OracleRolloutPolicy())
    session.run()
    before, end = actions(session), session.scene
    session.back(1)
    assert session.num_steps == 1 and session.outcome is None
    assert session.scene == session.steps[0].scene
    session.run()
    assert actions(session) == before and session.scene == end


def test_a_step_has_frames_from_before_to_after() -> None:
    session = EpisodeSession(EPISODE, OracleRolloutPolicy())
    step = session.step()
    assert step is not None and len(step.frames) > 30
    assert step.frames[-1].scene == step.scene == session.scene
    assert not EpisodeSession(EPISODE, OracleRolloutPolicy(), record=False).step().frames  # type: ignore[union-attr]


class RaisesAtTheSecondStep(RandomPolicy):
    def act(self, observations):
        if hasattr(self, "acted"):
            raise ZeroDivisionError("of the policy")
        self.acted = True
        return super().act(observations)


def test_what_a_policy_raises_is_a_value_and_the_user_can_act() -> None:
    session = EpisodeSession(EPISODE, RaisesAtTheSecondStep())
    assert session.step() is not None
    assert session.step() is None and session.num_steps == 1 and session.outcome is None
    assert "ZeroDivisionError" in str(session.propose().error)
    oracle = EpisodeSession(EPISODE, OracleRolloutPolicy()).propose().action
    assert oracle is not None
    assert session.step(oracle) is not None and session.num_steps == 2


def test_an_invalid_action_of_a_user_moves_nothing() -> None:
    session = EpisodeSession(EPISODE)
    with pytest.raises(ActionError):
        session.step(Action((0.0, 0.0), (9.0, 0.0)))
    assert session.num_steps == 0 and session.outcome is None
    assert session.step() is None  # without a policy, nobody acts


def test_an_invalid_action_of_a_policy_ends_the_episode_as_in_an_evaluation() -> None:
    class Outside(RandomPolicy):
        def act(self, observations):
            (action,) = super().act(observations)
            return [{**action, "pose0_position": np.full(2, 9, np.float32)}]  # type: ignore[dict-item]

    session = EpisodeSession(EPISODE, Outside())
    assert session.step() is None
    assert session.outcome is not None and "pose0_position" in session.outcome.reason


def test_another_policy_decides_from_where_the_episode_is() -> None:
    session = EpisodeSession(EPISODE, RandomPolicy())
    session.step()
    session.policy = OracleRolloutPolicy()
    assert session.num_steps == 1
    oracle = EpisodeSession(EPISODE, OracleRolloutPolicy())
    oracle.step(session.steps[0].action)
    assert session.propose().action == oracle.propose().action


def test_the_first_difference_of_two_runs() -> None:
    runs = [EpisodeSession(EPISODE, OracleRolloutPolicy()) for _ in range(2)]
    for run in runs:
        run.run()
    assert first_difference(runs[0].steps, runs[1].steps) is None
    other = EpisodeSession(EPISODE, RandomPolicy())
    other.step(runs[0].steps[0].action)
    other.step()
    assert first_difference(runs[0].steps, other.steps) == 1


def test_a_composed_scene_ends_from_its_file_as_it_did_in_its_session(tmp_path: Path) -> None:
    assets, goals = load_assets("procedural"), (("in", "a", "b"), ("in", "c", "b"))
    scene = Composition((), "Put the {a} and the {c} into the {b}.", goals=goals, max_steps=3)
    for name in ("block", "container", "heart"):
        scene = scene.added(name, "red swirl", assets)
    episode = scene.moved("a", (0.4, 0.2), 30).changed("c", scale=0.8).episode(assets)
    session = EpisodeSession(episode, load_own_rollout_policy(SMALL))  # as in the studio
    outcome = session.run()
    played = play(load_episode(save_episode(episode, tmp_path / "scene.yaml")), SMALL)  # as in `demo`
    assert actions(session) and list(played.actions) == actions(session)
    assert outcome is not None and (played.outcome.success, played.outcome.reason) == (
        outcome.success,
        outcome.reason,
    )
    assert played.scene == session.scene
