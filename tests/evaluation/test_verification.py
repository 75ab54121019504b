"""Verification of results: replayed outcomes, and forgeries that are found."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from openvima.env import EnvConfig
from openvima.errors import DatasetError, OpenVimaError
from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.evaluation.actions import ACTIONS_NAME, ActionReplay
from openvima.evaluation.rollout import BAD_ACTION, play, roll_out
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.evaluation.verification import VERIFICATION_NAME, is_marked_verified, verify_results
from openvima.scene import Action

TASKS = ("rotate", "sweep_without_exceeding")


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    """Oracle and random policy on two tasks."""
    out = tmp_path_factory.mktemp("evaluation")
    evaluate(EvaluationConfig(("oracle", "random"), TASKS, ("L1",), episodes=2, seed=60, batch=1, out=out))
    return out


@pytest.fixture
def copy(evaluation, tmp_path):
    return shutil.copytree(evaluation, tmp_path / "copy")


def test_every_outcome_is_confirmed_and_marked(copy):
    assert not is_marked_verified(copy)
    found = verify_results(copy)
    assert (found.problems, found.episodes) == ((), 8)
    assert is_marked_verified(copy)
    assert json.loads((copy / VERIFICATION_NAME).read_text())["sha256"] == found.sha256


def test_text_prompts_of_all_tasks_are_confirmed(tmp_path):
    text = EnvConfig(prompts="text")
    evaluate(EvaluationConfig(("random",), levels=("L1",), episodes=1, out=tmp_path, env_config=text))
    found = verify_results(tmp_path)
    assert (found.problems, found.episodes) == ((), 8)


def test_task_options_are_replayed_and_those_of_a_stranger_checked(tmp_path):
    hard = EnvConfig(task_options="difficulty=hard")
    config = EvaluationConfig(("oracle",), ("twist",), ("L1",), episodes=2, out=tmp_path, env_config=hard)
    evaluate(config)
    assert Results.read(tmp_path / "results.json").config["task_options"] == "difficulty=hard"
    assert verify_results(tmp_path).problems == ()
    path = tmp_path / "results.json"
    text = path.read_text()
    path.write_text(text.replace('"difficulty=hard"', '""'))
    assert len(verify_results(tmp_path).problems) > 0
    path.write_text(text.replace("difficulty=hard", "__class__.x=1"))
    with pytest.raises(OpenVimaError, match="there is no task '__class__'"):
        verify_results(tmp_path)


def test_the_mark_belongs_to_the_results_that_were_confirmed(copy):
    verify_results(copy)
    path = copy / "results.json"
    text = path.read_text()
    for old, new in ((json.loads(text)["sha256"], "0" * 64), ('"success": true', '"success": false')):
        path.write_text(text.replace(old, new, 1))
        assert not is_marked_verified(copy)
    path.write_text(text)
    assert is_marked_verified(copy)
    actions = copy / ACTIONS_NAME
    actions.write_bytes(actions.read_bytes()[:200])
    assert not is_marked_verified(copy)


def is_found(folder):
    """Whether the verification contradicts or refuses the results."""
    try:
        return not verify_results(folder).is_verified
    except OpenVimaError:
        return True


def shift_all_seeds(content):
    content["config"]["seed"] += 7
    for row in content["rows"]:
        for outcome in row["outcomes"]:
            outcome["seed"] += 7


def add(name, amount, *, of="outcome"):
    """Return a forgery: a larger number in an outcome, a row, a level or the versions."""

    def forge(content):
        row = content["rows"][-1]
        places = {"outcome": row["outcomes"][0], "row": row, "level": content["levels"][0]}
        place = places.get(of, content["versions"])
        place[name] = not place[name] if name == "success" else (place[name] or 0) + amount

    return forge


COUNTS = ("successes", "episodes", "rate", "mean_steps", "successes_oracle_horizon")


@pytest.mark.parametrize(
    ("forge", "renews_digest"),
    [
        *((add(name, 1), True) for name in ("success", "steps", "resamples", "oracle_max_steps", "seed")),
        (shift_all_seeds, True),
        *((add(name, ".1", of="versions"), True) for name in ("mujoco", "environments")),
        (add("steps", 1), False),
        *((add(name, 1, of="row"), False) for name in COUNTS),  # which a new digest would come with anew
        (add("mean", 0.1, of="level"), False),
    ],
)
def test_forgeries_are_found(copy, forge, renews_digest):
    path = copy / "results.json"
    content = json.loads(path.read_text())
    forge(content)
    path.write_text(json.dumps(content))
    if renews_digest:
        path.write_text(Results.read(path).to_json())
    assert is_found(copy)
    assert not (copy / VERIFICATION_NAME).exists()


def test_a_left_out_task_is_found(copy):
    path = copy / "results.json"
    results = Results.read(path)
    kept = tuple(row for row in results.rows if (row.policy, row.task) != ("random", "rotate"))
    fewer = Results(kept, results.config, results.versions, results.policies, results.actions_sha256)
    path.write_text(fewer.to_json())
    with pytest.raises(DatasetError, match="other steps than results"):
        verify_results(copy)


def test_exchanged_actions_are_found(copy):
    path = copy / ACTIONS_NAME
    content = bytearray(path.read_bytes())
    spot = content.find(np.float32(np.sqrt(0.5)).tobytes())
    place = spot if spot > 0 else len(content) // 2
    content[place : place + 4] = np.float32(0.25).tobytes()
    path.write_bytes(content)
    assert is_found(copy)


def test_damaged_actions_are_refused_and_without_any_nothing_is_confirmed(copy):
    path = copy / ACTIONS_NAME
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(DatasetError, match="damaged"):
        verify_results(copy)
    path.unlink()
    with pytest.raises(DatasetError, match=r"there is no .*actions\.arrow"):
        verify_results(copy)


class OnceRight:
    """Acts validly in the first step and not afterwards."""

    def reset(self, prompts):
        self.steps = 0

    def act(self, observations):
        self.steps += 1
        action = Action.planar((0.5, 0.0), (0.5, 0.0)).to_arrays()
        if self.steps > 1:
            action["pose1_position"] += 9
        return [None if observation is None else action for observation in observations]


def test_an_episode_that_an_invalid_action_ends_is_replayed_up_to_it():
    env = EnvConfig().make("rotate", "L1", domain="eval")
    (played,) = roll_out([env], [3], PromptedRolloutPolicy(OnceRight()))
    outcome, actions = played.outcome, np.array(played.actions, np.float32)
    assert (outcome.kind, outcome.steps, actions.shape) == (BAD_ACTION, 1, (1, 12))
    (again,) = play([env], [3], ActionReplay([actions]))
    assert (again.success, again.steps) == (False, 1)


@pytest.mark.slow
def test_harder_episodes_are_replayed_with_their_own_environment(tmp_path):
    ablations, policy = ("num_distractors:6", "paraphrased_prompts"), "mine=openvima.policies:RandomPolicy"
    config = EvaluationConfig(
        (policy,), ("rotate", "pick_in_order_then_restore"), ("L1",), 1, out=tmp_path, ablations=ablations
    )
    path = evaluate(config)
    found = verify_results(tmp_path)
    assert (found.problems, found.episodes) == ((), 2 + 1 + 2)  # of two tasks one has the option
    results = Results.read(path)
    rows = tuple(replace(row, ablation=row.ablation.replace("6", "2")) for row in results.rows)
    settings = {**results.config, "ablations": ["num_distractors:2", "paraphrased_prompts"]}
    path.write_text(replace(results, rows=rows, config=settings).to_json())
    assert (
        "num_distractors:2), rotate, L1, seed 0, replayed: reason is" in verify_results(tmp_path).problems[0]
    )
    path.write_text(replace(results, rows=rows).to_json())
    assert "the ablations of the rows are not those of the settings" in verify_results(tmp_path).problems
    for row in results.rows:  # under an ablation that does not exist, or for another task
        edited = (replace(row, ablation="nothing"), replace(row, task="twist", ablation="num_distractors:6"))
        path.write_text(replace(results, rows=(*results.rows[:-1], edited[row.ablation == ""])).to_json())
        assert is_found(tmp_path)
