"""Other phrasings: they hold the same slots, and training never sees a held-out one."""

import re

import pytest

from openvima.env import TabletopEnv
from openvima.evaluation.ablations import ablate
from openvima.evaluation.prompt_ablations import held_out_phrasings
from openvima.scene.prompt import PLACEHOLDER
from openvima.tasks import sample_episode, task_spec
from openvima.tasks.prompts import rephrase, training_paraphrases

TASKS = ("visual_manipulation", "rotate", "scene_understanding", "same_shape", "rearrange")


def words_of(text: str) -> str:
    """A phrasing without case, punctuation and names of slots."""
    return " ".join(re.findall(r"\w+", PLACEHOLDER.sub("SLOT", text).lower()))


def test_phrasings_have_the_slots_of_their_task():
    held_out = held_out_phrasings()
    assert tuple(held_out) == TASKS
    assert {len(set(phrasings)) for phrasings in held_out.values()} == {20}
    for phrasings in (held_out, training_paraphrases()):
        for task, templates in phrasings.items():
            slots = set(PLACEHOLDER.findall(task_spec(task).template))
            assert all(set(PLACEHOLDER.findall(each)) == slots for each in templates)


def test_no_held_out_phrasing_is_trained_on():
    trained = {words_of(each) for texts in training_paraphrases().values() for each in texts}
    trained |= {words_of(task_spec(task).template) for task in training_paraphrases()}
    held_out = {words_of(each) for texts in held_out_phrasings().values() for each in texts}
    assert not trained & held_out


def test_training_paraphrases_are_of_training_tasks_and_do_not_ask_for_textures():
    for task, templates in training_paraphrases().items():
        assert "train" in task_spec(task).levels
        assert not any(re.search(r"\btextures?\b", PLACEHOLDER.sub("", each)) for each in templates)


@pytest.mark.parametrize("prompts", ["multimodal", "text"])
@pytest.mark.parametrize("task", TASKS)
def test_each_prompt_of_the_task_can_be_put_in_other_words(task, prompts):
    if prompts == "text" and task in ("rearrange", "scene_understanding"):
        pytest.skip("its prompts have no object images")
    env = TabletopEnv(task, level="L1", domain="user", prompts=prompts)
    seen = set()
    for seed in range(3):
        env.reset(seed=seed)
        text = ablate(env, "held_out_phrasings").prompt.text
        assert text == ablate(env, "held_out_phrasings").prompt.text != env.prompt.text
        assert sorted(PLACEHOLDER.findall(text)) == sorted(PLACEHOLDER.findall(env.prompt.text))
        assert re.findall(r"\d+", PLACEHOLDER.sub("", text)) == re.findall(
            r"\d+", PLACEHOLDER.sub("", env.prompt.text)
        )
        seen.add(text)
    assert len(seen) > 1


@pytest.mark.parametrize("task", sorted(training_paraphrases()))
def test_prompts_of_training_tasks_follow_their_template(task):
    (phrasing, *_), template = training_paraphrases()[task], task_spec(task).template
    prompts = [
        sample_episode(task, level="train", domain="user", seed=seed).problem.prompt for seed in range(4)
    ]
    said = [rephrase(prompt.text, template, phrasing) for prompt in prompts]
    assert any(said)  # the definitions of novel_noun come in either order, and the template has one
    for prompt, text in zip(prompts, said, strict=True):
        assert text is None or set(PLACEHOLDER.findall(text)) == {name for name, _ in prompt.images}


def test_a_slot_that_occurs_twice_has_one_value_and_an_adverb_may_be_empty():
    template = "This is a {n} {a}. Put the {adv}{n} {a} here."
    assert rephrase("This is a wug {a}. Put the wug {a} here.", template, "{adv}|{n}") == "|wug"
    assert rephrase("This is a wug {a}. Put the less wug {a} here.", template, "{adv}|{n}") == "less |wug"
    assert rephrase("This is a wug {a}. Put the dax {a} here.", template, "{n}") is None


def test_text_of_another_form_has_no_phrasing():
    assert rephrase("Spin it.", "Rotate the {x} {n} degrees.", "Turn the {x} by {n}.") is None


def test_values_stay_where_a_phrasing_orders_slots_anew():
    text = rephrase(
        "Put the red bowl into the {b}.", "Put the {x} into the {y}.", "Into the {y} goes the {x}."
    )
    assert text == "Into the {b} goes the red bowl."


def test_a_description_of_several_words_is_one_value():
    text = rephrase(
        "Rotate the red letter A 30 degrees.", "Rotate the {x} {n} degrees.", "By {n} degrees, turn the {x}."
    )
    assert text == "By 30 degrees, turn the red letter A."
