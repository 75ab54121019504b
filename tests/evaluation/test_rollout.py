"""Playing episodes: who is asked when, and how episodes end."""

from types import SimpleNamespace

from openvima.errors import ActionError, OracleError
from openvima.evaluation.results import BAD_ACTION
from openvima.evaluation.rollout import (
    NO_ORACLE_ACTION,
    NOTHING_PICKED,
    OUT_OF_STEPS,
    WRONG_PICKED,
    play,
)
from openvima.scene import Action, RenderedPrompt

GO = Action.planar((0.5, 0.0), (0.5, 0.1))


class Env:
    """An environment that ends as its script says: for each step what it changes in the info."""

    control = "primitives"
    oracle_max_steps = 1

    def __init__(self, *script, end_effector="suction"):
        self.script = list(script)
        self.end_effector = end_effector
        self.prompt = RenderedPrompt("Wait.", {})
        self.actions = []
        goals = (SimpleNamespace(object_id=5), SimpleNamespace(object_id=6))
        problem = SimpleNamespace(goals=goals, prerequisites=(), num_required=None)
        self.episode = SimpleNamespace(num_redraws=2, problem=problem)
        self.progress = SimpleNamespace(open_goals=(1,))

    def reset(self, seed):
        self.steps, self.episode.seed = 0, seed
        return {"seed": seed, "step": 0}, {}

    def observe(self):
        assert self.steps < len(self.script), "nobody reads what is seen after the end"
        return {"seed": 0, "step": self.steps}

    def advance(self, action):
        if action == "bad":
            raise ActionError("pose0_position is (9, 9). Nothing was moved.")
        self.actions.append(action)
        info = {
            "success": False,
            "failure": False,
            "reason": "",
            "grasped": 0,
            "end_effector": self.end_effector,
        }
        info |= self.script[self.steps]
        self.steps += 1
        terminated = info["success"] or info["failure"]
        truncated = self.steps == len(self.script) and not terminated
        return 0.0, terminated, truncated, info


class RolloutPolicy:
    """Gives the same action and notes whom it was asked for."""

    def __init__(self, decision=GO):
        self.decision = decision
        self.asked = []

    def begin(self, envs):
        self.num_envs = len(envs)

    def decide(self, observations):
        self.asked.append([observation is not None for observation in observations])
        return [None if observation is None else self.decision for observation in observations]


def test_success_failure_and_step_limit_are_told_apart():
    solved = Env({}, {"success": True})
    failed = Env({"failure": True, "reason": "object 5 (red letter A) left the workspace"})
    slow = Env({"grasped": 5}, {}, {})
    outcomes = play([solved, failed, slow], [10, 11, 12], RolloutPolicy())
    assert [(o.seed, o.success, o.steps) for o in outcomes] == [(10, True, 2), (11, False, 1), (12, False, 3)]
    assert outcomes[1].reason == "object 5 (red letter A) left the workspace"
    assert [o.kind for o in outcomes] == ["", "object left the workspace", OUT_OF_STEPS]


def test_the_rollout_policy_is_asked_for_running_episodes_only():
    player = RolloutPolicy()
    play([Env({"success": True}), Env({}, {}, {})], [0, 1], player)
    assert player.num_envs == 2
    assert player.asked == [[True, True], [False, True], [False, True]]


def test_an_episode_without_any_pick_is_counted_apart_with_the_suction_cup_only():
    cup, spatula = Env({}, {}), Env({}, {}, end_effector="spatula")
    assert [o.kind for o in play([cup, spatula], [0, 1], RolloutPolicy())] == [NOTHING_PICKED, OUT_OF_STEPS]


def test_an_episode_in_which_only_other_objects_were_picked_is_counted_apart():
    wrong, right = Env({"grasped": 9}, {}), Env({"grasped": 9}, {"grasped": 6})
    outcomes = play([wrong, right], [0, 1], RolloutPolicy())
    assert [o.kind for o in outcomes] == [WRONG_PICKED, OUT_OF_STEPS]
    assert outcomes[1].reason == f"{OUT_OF_STEPS}: 1 of 2 goals were met"


def test_outcomes_hold_the_strict_limit_and_the_decisions_that_rounding_may_have_made():
    class Wavering(RolloutPolicy):
        @property
        def near_ties(self):
            return [True, len(self.asked) == 2]

    outcomes = play([Env({}, {}, {"success": True}), Env({}, {}, {})], [0, 1], Wavering())
    assert [o.near_ties for o in outcomes] == [3, 1]
    assert {o.oracle_max_steps for o in outcomes} == {1}


def test_an_impossible_action_fails_its_episode_alone():
    class HalfBad(RolloutPolicy):
        def decide(self, observations):
            return ["bad", *super().decide(observations)[1:]]

    outcomes = play([Env({}), Env({"success": True})], [0, 1], HalfBad())
    assert [(o.success, o.steps) for o in outcomes] == [(False, 0), (True, 1)]
    assert outcomes[0].kind == BAD_ACTION
    assert "pose0_position" in outcomes[0].reason


def test_an_oracle_without_an_action_fails_the_episode():
    (outcome,) = play([Env({})], [0], RolloutPolicy(OracleError("object 5 cannot be seen")))
    assert (outcome.kind, outcome.reason) == (NO_ORACLE_ACTION, "object 5 cannot be seen")


def test_whoever_watches_sees_every_step_but_no_action_that_was_refused():
    class BadAtLast(RolloutPolicy):
        def decide(self, observations):
            super().decide(observations)
            return [GO if len(self.asked) < 3 else "bad"]

    env, seen = Env({}, {}, {}), []
    (outcome,) = play([env], [0], BadAtLast(), after_step=lambda env: seen.append(env.steps))
    assert (outcome.kind, outcome.steps, seen) == (BAD_ACTION, 2, [1, 2])
