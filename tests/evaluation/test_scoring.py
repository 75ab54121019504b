"""Scoring policies that exist as objects only."""

from collections.abc import Callable

import numpy as np
import pytest

import openvima
from openvima.errors import ConfigError, PolicyError
from openvima.evaluation import Results, score
from openvima.evaluation.results import POLICY_ERROR
from openvima.policies import RandomPolicy
from openvima.policies.base import prompt_hash

CELLS = {"tasks": ("rotate", "visual_manipulation"), "levels": ("L1", "L2"), "episodes": 3, "seed": 5}


class Idle:
    """Never moves anything, and notes the sizes of the batches."""

    def __init__(self):
        self.batches = []

    def reset(self, prompts):
        self.batches.append(len(prompts))
        self.random = RandomPolicy()
        self.random.reset(prompts)

    def act(self, observations):
        actions = self.random.act(observations)
        for action in actions:
            if action is not None:
                action["pose0_position"][:] = action["pose1_position"][:] = (0.25, -0.5)
        return actions


def test_each_policy_has_rows_under_its_own_name():
    idle = Idle()
    results = score({"idle": idle, "random": RandomPolicy()}, **CELLS)
    assert results.policy_names() == ["idle", "random"]
    assert all(row.successes == 0 for row in results.rows if row.policy == "idle")
    assert idle.batches == [3] * 4


def test_ablations_are_played_with_objects_too():
    results = score({"idle": Idle()}, **{**CELLS, "episodes": 1}, ablations=("no_prompt", "oracle"))
    played = {(row.policy, row.ablation): row.successes for row in results.rows}
    assert played == {("idle", ""): 0, ("idle", "no_prompt"): 0, ("oracle", ""): 1}
    assert results.policies == {
        "idle": {"kind": "object", "modalities": ["rgb", "segm"]},
        "oracle": {"kind": "oracle"},
    }


def test_names_of_tasks_and_levels_may_stand_alone():
    one = {"tasks": "rotate", "levels": "L1", "episodes": 1}
    listed = {"tasks": ["rotate"], "levels": ["L1"], "episodes": 1}
    assert score({"random": RandomPolicy()}, **one) == score({"random": RandomPolicy()}, **listed)


def test_harder_episodes_leave_out_other_tasks_and_moved_boxes_need_a_network():
    cells = {"tasks": ("rotate", "pick_in_order_then_restore"), "levels": ("L1",), "episodes": 1}
    rows = score({"idle": Idle()}, **cells, ablations=("text_prompts", "num_distractors:6")).rows
    assert [(row.ablation, row.task) for row in rows] == [
        ("", "rotate"),
        ("", "pick_in_order_then_restore"),
        ("text_prompts", "rotate"),
        ("text_prompts", "pick_in_order_then_restore"),
        ("num_distractors:6", "rotate"),
    ]
    with pytest.raises(ConfigError, match="policy idle extracts objects by code of its own"):
        score({"idle": Idle()}, **cells, ablations=("noisy_boxes:3+masked_words:0.2",))


@pytest.mark.parametrize("name", ["x=oracle", "my policy", "runs/a", "ws://host:1"])
def test_a_name_that_could_be_a_source_is_refused(name):
    with pytest.raises(ConfigError, match=f"polic.*{name.partition('=')[0]}"):
        score({name: RandomPolicy()}, tasks="rotate", levels="L1", episodes=1)


class Raising(RandomPolicy):
    """Raises in the episodes of some prompts, after an action."""

    def __init__(self, bad_prompts, error):
        super().__init__()
        self.bad, self.error = bad_prompts, error

    def reset(self, prompts):
        super().reset(prompts)
        self.num_acts, self.fails = 0, any(prompt_hash(prompt) in self.bad for prompt in prompts)

    def act(self, observations):
        if self.fails and self.num_acts == 1:
            raise self.error("no idea")
        self.num_acts += 1
        return super().act(observations)


def prompt_of(task, seed):
    env = openvima.make(task, level="L1", domain="eval")
    env.reset(seed=seed)
    return prompt_hash(env.prompt)


@pytest.mark.parametrize("error", [ZeroDivisionError, PolicyError])
def test_a_policy_that_raises_in_one_episode_loses_that_episode_only(error, tmp_path):
    cells = {"tasks": "visual_manipulation", "levels": "L1", "episodes": 4}
    bad = {prompt_of("visual_manipulation", 2)}
    usual = score({"mine": RandomPolicy()}, **cells).rows[0].outcomes
    results = score({"mine": Raising(bad, error)}, **cells)
    outcomes = results.rows[0].outcomes
    assert [o for o in outcomes if o.seed != 2] == [o for o in usual if o.seed != 2]
    assert (outcomes[2].success, outcomes[2].steps, outcomes[2].kind) == (False, 1, POLICY_ERROR)
    assert "no idea" in outcomes[2].reason
    assert results.rows[0].failures[POLICY_ERROR] == 1
    (found,) = results.policy_errors()
    assert (found["raised"], found["episodes"]) == (1, 4)
    assert found["first"].startswith("first in visual_manipulation, L1, seed 2: ")
    assert Results.read(results.write(tmp_path / "results.json")) == results


class Given:
    """Gives the same value as each position."""

    def __init__(self, make: Callable[[], object]):
        self.make = make

    def reset(self, prompts):
        """Nothing is kept."""

    def act(self, observations):
        turn = np.array([0, 0, 0, 1], np.float32)
        action = {"pose0_rotation": turn, "pose1_rotation": turn}
        return [
            {**action, "pose0_position": self.make(), "pose1_position": self.make()} for _ in observations
        ]


@pytest.mark.parametrize(("nested", "control"), [(False, "primitives"), (True, "end_effector")])
def test_tensors_with_gradients_are_an_error_that_names_policy_task_and_seed(nested, control):
    torch = pytest.importorskip("torch")

    def make() -> object:
        values = torch.full((5 if control == "end_effector" else 2,), 0.5, requires_grad=True)
        return list(values) if nested else values

    policy = Given(make)
    if control == "end_effector":
        policy.control = control
        policy.act = lambda observations: [make() for _ in observations]
    cells = {"tasks": "rotate", "levels": "L1", "episodes": 1, "seed": 3, "control": control}
    with pytest.raises(
        PolicyError, match=r"mine raised RuntimeError.*detach.*in rotate, L1, seed 3"
    ) as error:
        score({"mine": policy}, **cells)
    assert "\n" not in str(error.value)
