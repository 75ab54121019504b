"""Prompt augmentation: text descriptions in place of object images."""

from dataclasses import replace

import numpy as np
import pytest

from openvima.data import Dataset
from openvima.data.object_cache import open_object_cache
from openvima.data.preprocessed import preprocess
from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.perception.preprocessing import split_prompt
from openvima.policies.processor import Processor
from openvima.policies.tokenizer import Vocabulary, WordTokenizer
from openvima.scene import ObjectRecord
from openvima.tasks.prompts import describe, description_of, image_descriptions, synonyms
from openvima.training.augmentation.prompts import (
    describe_objects,
    rename_objects,
    text_of,
    with_descriptions,
    with_synonyms,
)
from openvima.training.batches import Example
from openvima.training.building import training_texts
from openvima.training.config import AugmentationConfig
from openvima.training.learner import PolicyCollate
from small_data_sets import rows_of

TASKS = (
    "visual_manipulation",
    "sweep_without_exceeding",
    "novel_noun",
    "scene_understanding",
    "follow_motion",
)
ALWAYS = AugmentationConfig(text_description_prob=1.0)


@pytest.fixture(scope="module")
def demos() -> dict[str, Demonstration]:
    def demo(task: str) -> Demonstration:
        env = TabletopEnv(task, level="L4" if task == "follow_motion" else "train", domain="user")
        return rollout_oracle(env, 1)

    return {task: demo(task) for task in TASKS}


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("kind", ["objects", "frames"])
def test_all_object_images_become_the_text_of_text_prompts(demos, task, kind) -> None:
    episode = preprocess(demos[task], kind)
    changed = with_descriptions(episode, 1.0, np.random.default_rng(0))
    text = describe(demos[task].prompt, "text")
    assert changed.prompt.text == text.text
    assert changed.prompt.image_names == tuple(text.images)
    assert all(changed.prompt.is_scene) and len(changed.prompt.is_scene) == len(text.images)
    assert sum(changed.prompt.objects_per_image) == len(changed.prompt.objects)
    assert changed.objects is episode.objects and changed.actions is episode.actions


def test_each_image_is_replaced_with_that_probability_and_the_others_stay(demos) -> None:
    episode = preprocess(demos["visual_manipulation"], "objects")
    rows = dict(zip(episode.prompt.image_names, rows_of(episode.prompt.objects).tolist(), strict=True))
    shown = []
    for seed in range(200):
        prompt = with_descriptions(episode, 0.25, np.random.default_rng(seed)).prompt
        shown.append(prompt.image_names)
        assert rows_of(prompt.objects).tolist() == [rows[name] for name in prompt.image_names]
        assert all(
            (text in prompt.text) != (name in shown[-1]) for name, text in episode.descriptions.items()
        )
    for name in rows:
        assert 0.65 < np.mean([name in names for names in shown]) < 0.85
    assert len(set(shown)) == 4  # independently


def test_whole_prompts_become_text_with_a_probability_of_their_own(demos) -> None:
    episode = preprocess(demos["visual_manipulation"], "objects")
    rng = np.random.default_rng(0)
    config = AugmentationConfig(text_description_prob=0.25, text_prompt_prob=0.5)
    described = [describe_objects(episode, rng, config) for _ in range(1000)]
    shown = [each.prompt.image_names for each in described]
    assert 0.48 < np.mean([names == () for names in shown]) < 0.58  # 0.5 + 0.5 · 0.25²
    assert len(set(shown)) == 4  # the others one by one


def test_synonyms_are_aliases_of_the_catalogue(demos) -> None:
    assert synonyms("red shorter block") == synonyms("red block") == ("red cube",)
    assert synonyms("red L-shaped block") == ("red L-shape",)
    assert synonyms("red small block") == synonyms("cyan thing") == ()
    episode = replace(
        preprocess(demos["visual_manipulation"], "objects"), descriptions={"a": "block", "b": "pan"}
    )
    said = [with_synonyms(episode, 0.5, np.random.default_rng(seed)).descriptions for seed in range(60)]
    assert {each["b"] for each in said} == {"pan"}
    assert 0.3 < np.mean([each["a"] == "cube" for each in said]) < 0.7


def test_the_object_cache_holds_the_descriptions(data) -> None:
    dataset = Dataset(data)
    cache = open_object_cache(dataset)
    for demo, episode in zip(dataset, cache, strict=True):
        assert episode.descriptions == image_descriptions(demo.prompt) != {}


def test_words_of_descriptions_are_in_the_vocabulary(data) -> None:
    dataset = Dataset(data)
    augmentation = replace(ALWAYS, rename_objects_prob=1.0)
    tokenizer = WordTokenizer(Vocabulary().extended(training_texts(dataset, augmentation)))
    for episode in open_object_cache(dataset):
        for changed in (episode, rename_objects(episode, np.random.default_rng(episode.seed))):
            text = with_descriptions(changed, 1.0, np.random.default_rng(0)).prompt.text
            for piece in split_prompt(text):
                if isinstance(piece, str):
                    tokenizer.encode(piece)  # a warning of unknown words is an error in tests
    without = Vocabulary().extended(training_texts(dataset, AugmentationConfig()))
    assert {"red", "bowl"} & set(tokenizer.vocabulary.words) - set(without.words)


def test_it_changes_prompts_of_tasks_in_training_only(demos) -> None:
    processor = Processor("objects")
    example = Example(preprocess(demos["visual_manipulation"], "objects"))

    def batch(augmentation: AugmentationConfig, rngs: list[np.random.Generator] | None):
        return PolicyCollate(processor, 0.0, with_images=True, augmentation=augmentation)([example], rngs)

    def words(augmentation: AugmentationConfig, *, is_training: bool) -> list[int]:
        made = batch(augmentation, [np.random.default_rng(0)] if is_training else None)
        return made.prompts.word_ids_BL[0].tolist()

    plain = words(AugmentationConfig(), is_training=True)
    assert words(ALWAYS, is_training=False) == plain != words(ALWAYS, is_training=True)
    motion = replace(ALWAYS, inverse_dynamics_prob=1.0)
    never = replace(motion, text_description_prob=0.0)
    assert words(motion, is_training=True) == words(never, is_training=True)


def test_a_description_comes_with_its_article_and_plural() -> None:
    assert description_of(ObjectRecord(0, "letter A", "red swirl")) == "red swirl letter A"
    assert text_of("iron box") == "all iron boxes. The iron box. is a zup: an iron box"
