"""In-context evaluation: prompts of three tasks contain an example from their own images."""

import numpy as np
import pytest

from openvima.cli.main import main
from openvima.env import TabletopEnv
from openvima.errors import ConfigError, PromptError
from openvima.evaluation import EvaluationConfig, Results
from openvima.evaluation.ablations import ABLATIONS, EXAMPLE_PROMPTS, IN_CONTEXT, ablate
from openvima.evaluation.config import cells
from openvima.evaluation.prompt_ablations import IN_CONTEXT_TASKS, in_context_prompt
from openvima.evaluation.sources import policy_sources
from openvima.evaluation.verification import verify_results
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
    env = TabletopEnv(task, level=task_spec(task).levels[-1], domain="eval")
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


def test_twist_takes_its_first_pair_whatever_their_number() -> None:
    env = TabletopEnv("twist", level="L1", num_examples=1)
    env.reset(seed=0)
    one = in_context_prompt(env.prompt, "twist")
    more = TabletopEnv("twist", level="L1", num_examples=2)
    more.reset(seed=0)
    two = in_context_prompt(more.prompt, "twist")
    assert one.text == two.text and list(two.images) == ["before_twist_1", "after_twist_1"]
    np.testing.assert_array_equal(
        one.images["after_twist_1"].rgb["top"], two.images["after_twist_1"].rgb["top"]
    )


def test_other_tasks_and_prompts_are_refused() -> None:
    env = TabletopEnv("rotate", level="L1")
    env.reset(seed=0)
    with pytest.raises(
        ConfigError, match=r"no in-context evaluation of task 'rotate'.* Allowed: twist, foll"
    ):
        in_context_prompt(env.prompt, "rotate")
    with pytest.raises(PromptError, match=r"'Rotate the {dragged_obj} .* is no prompt of twist"):
        in_context_prompt(env.prompt, "twist")
    with pytest.raises(
        ConfigError, match=r"no in-context evaluation of task 'twists'. Did you mean 'twist'\?"
    ):
        EvaluationConfig(("untrained",), ("twists",), ablations=(IN_CONTEXT,))


def test_all_leaves_out_prompts_with_an_example() -> None:
    (source,) = policy_sources(("untrained",))
    asked = EvaluationConfig(("untrained",), ablations=("all", *EXAMPLE_PROMPTS)).ablations_of(source)
    assert asked == (*(name for name in ABLATIONS if name != "detected_boxes"), *EXAMPLE_PROMPTS)
    assert not {*EXAMPLE_PROMPTS} & {
        *EvaluationConfig(("untrained",), ablations=("all",)).ablations_of(source)
    }


def test_by_default_the_tasks_are_those_with_an_edited_prompt() -> None:
    config = EvaluationConfig(("untrained",), ablations=(IN_CONTEXT,))
    assert {task for task, _ in cells(config)} == {*IN_CONTEXT_TASKS}


def test_the_command_plays_the_held_out_tasks_with_either_prompt(tmp_path) -> None:
    pytest.importorskip("torch")
    words = ["evaluate", "--policy", "untrained", "--in-context", "--episodes", "1", "--no-report"]
    assert main([*words, "--levels", "L1", "--out", str(tmp_path), "--batch", "1"]) == 0
    rows = Results.read(tmp_path / "results.json").rows
    assert {(row.task, row.ablation) for row in rows} == {
        (task, ablation) for task in ("twist", "follow_order") for ablation in ("", IN_CONTEXT)
    }
    assert verify_results(tmp_path).is_verified
