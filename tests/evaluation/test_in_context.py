"""Episodes with prompts of one's own: in context, and free play."""

from pathlib import Path

import numpy as np
import pytest

from openvima import compose
from openvima.cli.main import main
from openvima.data.records import rollout_oracle
from openvima.env import TabletopEnv, save_episode
from openvima.errors import ConfigError, OracleError, PolicyError, PromptError, UnknownPolicyError
from openvima.evaluation import EvaluationConfig, Results, play
from openvima.evaluation.ablations import ABLATIONS, IN_CONTEXT, ORACLE_DEMONSTRATION, ablate
from openvima.evaluation.config import plan
from openvima.evaluation.prompt_ablations import IN_CONTEXT_TASKS, in_context_prompt
from openvima.evaluation.sources import policy_sources
from openvima.evaluation.verification import verify_results
from openvima.policies import RandomPolicy
from openvima.policies.tokenizer import WordTokenizer
from openvima.scene import Action
from openvima.tasks import task_spec


@pytest.mark.parametrize(
    ("task", "words", "names"),
    [
        ("twist", ["Follow this motion:", "for all {texture} objects."], ["before_twist_1", "after_twist_1"]),
        (
            "follow_motion",
            ["Follow this motion for", ":", "."],
            ["dragged_obj", "frame_0", "frame_1", "frame_2"],
        ),
        ("follow_order", ["Follow this motion:", "."], ["frame_0", "frame_1", "frame_2"]),
    ],
)
def test_the_edited_prompt_shows_images_of_the_tasks_own(task, words, names) -> None:
    published = [level for level in task_spec(task).levels if level <= "L4"]
    env = TabletopEnv(task, level=published[-1], domain="eval")
    env.reset(seed=3)
    own, scene = env.prompt, env.scene
    prompt = ablate(env, IN_CONTEXT).prompt
    assert env.prompt is own and env.scene == scene
    texture = env.episode.problem.scene.placements[0].texture  # of a target of twist
    pieces = prompt.sequence()
    assert [piece for piece in pieces if isinstance(piece, str)] == [w.format(texture=texture) for w in words]
    assert [piece.name for piece in pieces if not isinstance(piece, str)] == names == list(prompt.images)
    assert all(prompt.images[name] is own.images[name] for name in names)
    if task == "twist":  # the turn is shown on an object of another texture
        assert texture not in {record.texture for image in prompt.images.values() for record in image.objects}


def test_other_tasks_and_prompts_are_refused() -> None:
    env = TabletopEnv("rotate", level="L1")
    env.reset(seed=0)
    with pytest.raises(PromptError, match=r"'Rotate the {dragged_obj} .* is no prompt of twist"):
        in_context_prompt(env.prompt, "twist")
    config = EvaluationConfig(("untrained",), ("rotate",), ablations=(IN_CONTEXT,))
    with pytest.raises(
        ConfigError, match=r"none of the tasks rotate; it does to follow_motion, follow_order, tw"
    ):
        plan(config)


def test_all_leaves_out_prompts_with_an_example() -> None:
    (source,) = policy_sources(("untrained",))
    asked = EvaluationConfig(
        ("untrained",), ablations=("all", IN_CONTEXT, ORACLE_DEMONSTRATION)
    ).ablations_of(source)
    assert asked == (
        *(name for name in ABLATIONS if name != "detected_boxes"),
        IN_CONTEXT,
        ORACLE_DEMONSTRATION,
    )
    assert not {IN_CONTEXT, ORACLE_DEMONSTRATION} & {
        *EvaluationConfig(("untrained",), ablations=("all",)).ablations_of(source)
    }


def test_the_command_plays_the_held_out_tasks_with_either_prompt(tmp_path) -> None:
    pytest.importorskip("torch")
    words = ["evaluate", "--policy", "untrained", "--in-context", "--episodes", "1", "--no-report"]
    assert main([*words, "--levels", "L1", "--out", str(tmp_path), "--batch", "1"]) == 0
    rows = Results.read(tmp_path / "results.json").rows
    assert {(row.task, row.ablation) for row in rows} == {
        (task, ablation) for task in ("twist", "follow_order") for ablation in ("", IN_CONTEXT)
    }
    assert verify_results(tmp_path).is_verified


OBJECTS = [("block", "red", (0.5, -0.2)), ("bowl", "green", (0.5, 0.2))]
PROMPT = "Put the {a} into the {b}."


class FirstIntoSecond:
    """Picks at (0.5, -0.2) and places at (0.5, 0.2)."""

    def reset(self, prompts):
        self.prompts = prompts

    def act(self, observations):
        return [Action.planar((0.5, -0.2), (0.5, 0.2), 0.0).to_arrays() for _ in observations]


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


@pytest.mark.parametrize("task", IN_CONTEXT_TASKS)
def test_the_prompt_is_the_motion_of_the_oracle_in_this_episode(task) -> None:
    env = TabletopEnv(task, level=task_spec(task).levels[-1], domain="eval")
    observation, _ = env.reset(seed=3)
    before = env.scene
    prompt = ablate(env, ORACLE_DEMONSTRATION).prompt
    assert env.scene == before
    demo = rollout_oracle(TabletopEnv(task, level=env.level, domain="eval"), 3)
    assert demo.outcome.success
    assert list(prompt.images) == [f"frame_{t}" for t in range(demo.num_steps + 1)]
    for t, image in enumerate(prompt.images.values()):
        for view in ("front", "top"):
            np.testing.assert_array_equal(image.rgb[view], demo.rgb[view][t])
            np.testing.assert_array_equal(image.segm[view], demo.segm[view][t])
        assert image.objects == tuple(sorted(demo.objects, key=lambda record: record.object_id))
    np.testing.assert_array_equal(prompt.images["frame_0"].rgb["top"], observation["rgb"]["top"])
    words = [piece for piece in prompt.sequence() if isinstance(piece, str)]
    assert words[0] == "Follow this motion:"
    WordTokenizer().encode(" ".join(words))


def test_an_oracle_that_finds_no_action_shows_what_it_did_until_then(monkeypatch) -> None:
    env = TabletopEnv("follow_order", level="L1", domain="eval")
    env.reset(seed=3)
    whole = ablate(env, ORACLE_DEMONSTRATION).prompt
    decide, asked = TabletopEnv.oracle_decision, []

    def once(own):
        asked.append(own)
        if len(asked) > 1:
            raise OracleError("nothing can be seen from above")
        return decide(own)

    monkeypatch.setattr(TabletopEnv, "oracle_decision", once)
    prompt = ablate(env, ORACLE_DEMONSTRATION).prompt
    assert list(prompt.images) == ["frame_0", "frame_1"]
    np.testing.assert_array_equal(prompt.images["frame_1"].rgb["top"], whole.images["frame_1"].rgb["top"])
