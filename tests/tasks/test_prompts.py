"""Prompts as text and in other words."""

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from openvima.catalog.partitions import PUBLISHED_TASKS
from openvima.env import TabletopEnv
from openvima.errors import ConfigError, PromptError
from openvima.evaluation.ablations import ablate
from openvima.evaluation.prompt_ablations import held_out_phrasings
from openvima.scene import (
    ObjectImage,
    ObjectRecord,
    Placement,
    Pose,
    Prompt,
    PromptImage,
    RenderedPrompt,
    Scene,
)
from openvima.scene.prompt import PLACEHOLDER
from openvima.tasks import list_tasks, make_rng, sample_episode, task_spec
from openvima.tasks.prompts import PROMPTS, describe, rephrase, rewrite, training_paraphrases
from openvima.tasks.sampling import has_text_form
from prompts import is_understood

SCENES_ONLY = {"follow_order", "rearrange", "rearrange_then_restore", "scene_understanding", "twist"}
COMPARING = {"novel_adj", "novel_adj_and_noun"}  # by height in half of the episodes
WITH_TEXT = sorted(set(PUBLISHED_TASKS) - SCENES_ONLY)
PAGE = Path(__file__).parents[2] / "docs" / "prompts.md"


def test_all_tasks_but_those_with_scenes_alone_have_a_text_form() -> None:
    assert {task for task in list_tasks() if not has_text_form(task)} >= SCENES_ONLY
    assert all(has_text_form(task) for task in WITH_TEXT)


@pytest.mark.parametrize("task", WITH_TEXT)
def test_a_reader_of_the_text_finds_the_goal_objects(task: str) -> None:
    for level in task_spec(task).levels:
        episodes = [
            sample_episode(task, level=level, seed=seed, prompts=("text", "text,paraphrased")[seed % 2])
            for seed in range(10 if task in COMPARING else 5)
        ]
        clear = [episode for episode in episodes if not episode.problem.prompt.is_ambiguous]
        assert clear and all(map(is_understood, clear))
        assert (clear != episodes) == (task in COMPARING)
        assert not any(is_understood(e) for e in episodes if e.problem.prompt.is_ambiguous)
        assert not any(isinstance(fill, ObjectImage) for e in episodes for _, fill in e.problem.prompt.images)


@pytest.mark.parametrize("task", ["rotate", "novel_adj", "rearrange", "follow_motion"])
def test_nothing_but_the_prompt_depends_on_its_form(task: str) -> None:
    published = sample_episode(task, seed=4)
    for prompts in PROMPTS:
        if task != "rearrange" or not prompts.startswith("text"):
            episode = sample_episode(task, seed=4, prompts=prompts)
            problem = replace(episode.problem, prompt=published.problem.prompt)
            assert replace(episode, problem=problem) == published
    assert sample_episode(task, seed=4, prompts="multimodal") == published


def test_mixed_prompts_describe_half_of_the_images_and_synonyms_choose_the_same() -> None:
    counts = Counter[bool]()
    for seed in range(30):
        all_images, mixed, synonyms = (
            dict(sample_episode("novel_noun", seed=seed, prompts=p).problem.prompt.images)
            for p in ("multimodal", "mixed", "mixed,paraphrased")
        )
        assert mixed == synonyms
        counts.update(name in mixed for name in all_images)
    assert 20 <= counts[True] <= 40


def test_synonyms_are_used_about_half_of_the_time() -> None:
    prompt = prompt_of("Put the {a} away.", a="block")
    words = Counter(
        rewrite(prompt, Scene(()), "text,paraphrased", make_rng("user", "t", "train", seed, "prompt")).text
        for seed in range(60)
    )
    assert set(words) == {"Put the red block away.", "Put the red cube away."}
    assert min(words.values()) > 15


def placed(name: str, texture: str = "red", object_id: int = 0) -> Placement:
    return Placement(object_id, name, texture, (0.1, 0.1, 0.1), Pose((0.0, 0.0, 0.0)))


def prompt_of(text: str, **images: str) -> Prompt:
    named = {
        slot: placed(words, "gray" if slot.startswith("gray") else "red") for slot, words in images.items()
    }
    return Prompt.parse(text, **{slot: ObjectImage(placement) for slot, placement in named.items()})


def text_of(prompt: Prompt) -> str:
    return rewrite(prompt, Scene(()), "text", make_rng("user", "t", "train", 0, "prompt")).text


@pytest.mark.parametrize(
    ("template", "text"),
    [
        ("Put {a} into {b}.", "Put the red heart into the red bowl."),
        ("Put the {a} into the same {b}.", "Put the red heart into the same red bowl."),
        ("{a} is on {b}. {a} is not!", "The red heart is on the red bowl. The red heart is not!"),
        ("Put a {a} onto any {b}", "Put a red heart onto any red bowl"),
        ("Sweep two {a} and all {b}", "Sweep two red hearts and all red bowls"),
        ("The same texture as {a}, {b}.", "The same texture as the red heart, the red bowl."),
        ("Put the less kobar {a} into {b}.", "Put the less kobar red heart into the red bowl."),
    ],
)
def test_descriptions_get_the_article_that_their_sentence_needs(template: str, text: str) -> None:
    assert text_of(prompt_of(template, a="heart", b="bowl")) == text


def test_shapes_alone_are_introduced_by_name() -> None:
    text = "This is a wug {gray_1}. This is a dax {gray_2}. Put a wug into a dax."
    prompt = prompt_of(text, gray_1="L-shaped block", gray_2="pan")
    assert text_of(prompt) == "This is a wug: an L-shaped block. This is a dax: a pan. Put a wug into a dax."
    assert text_of(prompt_of("Two {gray}", gray="cross")) == "Two crosses"
    assert text_of(prompt_of("A {gray}", gray="L-shaped block")) == "An L-shaped block"
    prompt = prompt_of("Reverse the order of {a} {b}.", a="letter A", b="bowl")
    assert text_of(prompt) == "Reverse the order of the red letter A the red bowl."  # "A" is no article


def test_words_that_fit_another_object_on_the_table_are_ambiguous() -> None:
    image = ObjectImage(placed("block", object_id=5))
    prompt = Prompt.parse("Rotate the {a} 30 degrees.", a=image)
    tall = replace(placed("block", object_id=6), scale=(1.0, 1.0, 2.0))

    def is_ambiguous(other: Placement, prompts: str = "text") -> bool:
        scene = Scene((image.placement, other))
        rngs = (make_rng("user", "t", "L1", seed, "prompt") for seed in range(10))
        return any(rewrite(prompt, scene, prompts, rng).is_ambiguous for rng in rngs)

    assert is_ambiguous(tall)
    assert not is_ambiguous(placed("block", "blue", 6))
    assert not is_ambiguous(placed("shorter block", object_id=6))
    assert is_ambiguous(placed("shorter block", object_id=6), "text,paraphrased")
    assert not sample_episode("novel_adj", seed=4).problem.prompt.is_ambiguous


def test_unknown_forms_and_tasks_without_text_are_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"there is no form of prompts 'txt'. Did you mean 'text'\? Allowed"
    ):
        sample_episode("rotate", seed=0, prompts="txt")
    with pytest.raises(ConfigError, match="'paraphrased'"):
        sample_episode("rotate", seed=0, prompts="paraphrased")
    with pytest.raises(
        ConfigError, match=r"'twist' has no text form.* Tasks with one: .*follow_motion, .*rotate"
    ):
        sample_episode("twist", seed=0, prompts="text")


def test_rendered_prompts_are_described_alike() -> None:
    def image(name: str, *records: ObjectRecord) -> PromptImage:
        return PromptImage(name, "object" if len(records) == 1 else "scene", {}, {}, records)

    heart, bowl = ObjectRecord(2, "heart", "red"), ObjectRecord(2, "own shape", "blue")
    images = {"a": image("a", heart), "b": image("b", bowl), "c": image("c", heart, bowl)}
    prompt = RenderedPrompt("Put the {a} into {b} as in {c}.", images)
    told = describe(prompt, "text")
    assert told.text == "Put the red heart into the blue own shape as in {c}."
    assert set(told.images) == {"c"}
    assert describe(prompt, "multimodal") is prompt
    assert describe(prompt, "mixed").text == describe(prompt, "mixed").text
    with pytest.raises(PromptError, match="image a has names of over 200"):
        describe(RenderedPrompt("{a}", {"a": image("a", ObjectRecord(2, "x" * 300, "red"))}), "text")


@pytest.mark.parametrize("task", WITH_TEXT)
def test_the_page_quotes_the_text_of_each_task(task: str) -> None:
    text = sample_episode(task, seed=3, prompts="text").problem.prompt.text
    for row in re.findall(rf"\| `{task}` \| (.*) \|", PAGE.read_text(encoding="utf-8")):
        start, *end = row.split(" … ")  # the page shortens long ones, and leaves out some tasks
        assert text.startswith(start) and text.endswith(end[0] if end else start)


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


@pytest.mark.parametrize(
    ("task", "prompts"),
    [*((task, "multimodal") for task in TASKS), ("visual_manipulation", "text"), ("rotate", "text")],
)
def test_each_prompt_of_the_task_can_be_put_in_other_words(task, prompts):
    def slots_and_numbers(text):
        return sorted(PLACEHOLDER.findall(text)), re.findall(r"\d+", PLACEHOLDER.sub("", text))

    env = TabletopEnv(task, level="L1", domain="user", prompts=prompts)
    seen = set()
    for seed in range(3):
        env.reset(seed=seed)
        text = ablate(env, "held_out_phrasings").prompt.text
        assert text == ablate(env, "held_out_phrasings").prompt.text != env.prompt.text
        assert slots_and_numbers(text) == slots_and_numbers(env.prompt.text)
        seen.add(text)
    assert len(seen) > 1


@pytest.mark.parametrize("task", sorted(training_paraphrases()))
def test_prompts_of_training_tasks_follow_their_template(task):
    (phrasing, *_), template = training_paraphrases()[task], task_spec(task).template
    prompts = [sample_episode(task, seed=seed).problem.prompt for seed in range(4)]
    said = [rephrase(prompt.text, template, phrasing) for prompt in prompts]
    assert any(said)  # the definitions of novel_noun come in either order, and the template has one
    for prompt, text in zip(prompts, said, strict=True):
        assert text is None or set(PLACEHOLDER.findall(text)) == {name for name, _ in prompt.images}


TWICE = "This is a {n} {a}. Put the {adv}{n} {a} here."


@pytest.mark.parametrize(
    ("text", "template", "phrasing", "said"),
    [
        ("This is a wug {a}. Put the wug {a} here.", TWICE, "{adv}|{n}", "|wug"),  # an adverb may be empty
        ("This is a wug {a}. Put the less wug {a} here.", TWICE, "{adv}|{n}", "less |wug"),
        ("This is a wug {a}. Put the dax {a} here.", TWICE, "{n}", None),  # a slot has one value
        ("Spin it.", "Rotate the {x} {n} degrees.", "Turn the {x} by {n}.", None),
        ("Put a red bowl into {b}.", "Put a {x} into {y}.", "Into {y} goes {x}.", "Into {b} goes red bowl."),
        ("Rotate red letter A 30 degrees.", "Rotate {x} {n} degrees.", "{n}: {x}.", "30: red letter A."),
    ],
)
def test_the_values_of_a_text_are_put_into_a_phrasing(text, template, phrasing, said):
    assert rephrase(text, template, phrasing) == said
