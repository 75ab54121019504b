"""Scoring policies that exist as objects only."""

import pytest

from openvima.errors import ConfigError, PolicyError, UnknownTaskError
from openvima.evaluation import EvaluationConfig, Results, evaluate, score
from openvima.policies import RandomPolicy

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


def test_objects_play_the_very_episodes_that_evaluate_plays(tmp_path):
    config = EvaluationConfig(("random",), out=tmp_path, **CELLS)
    assert score({"random": RandomPolicy()}, **CELLS).rows == Results.read(evaluate(config)).rows


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


def test_names_may_stand_alone_and_policies_need_some():
    one = {"tasks": "rotate", "levels": "L1", "episodes": 1}
    listed = {"tasks": ["rotate"], "levels": ["L1"], "episodes": 1}
    assert score({"random": RandomPolicy()}, **one) == score({"random": RandomPolicy()}, **listed)
    with pytest.raises(PolicyError, match="policies is a RandomPolicy; give policies by name"):
        score(RandomPolicy(), **one)


def test_a_task_that_is_not_there_is_named():
    with pytest.raises(UnknownTaskError, match="rotat"):
        score({"random": RandomPolicy()}, tasks=("rotat",))


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
