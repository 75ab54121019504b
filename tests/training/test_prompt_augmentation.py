"""Prompt augmentation: renamed objects, shuffled sentences, dropped unused objects."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.preprocessed import number_images, preprocess
from openvima.data.records import rollout_oracle
from openvima.env import TabletopEnv
from openvima.errors import ConfigError
from openvima.perception.objects import observe
from openvima.policies.processor import Processor
from openvima.scene import Action
from openvima.tasks.novel_words import ADJECTIVES, NOUNS
from openvima.training import TrainingConfig, train
from openvima.training.augmentation.demonstrations import (
    MAX_DISTRACTORS,
    augment,
    drop_unused_objects,
    with_distractors,
)
from openvima.training.augmentation.prompts import (
    paraphrase,
    rename_objects,
    shuffle_prompt_objects,
    shuffle_sentences,
    turn_comparisons,
    with_motion_prompt,
    with_unused_definitions,
)
from openvima.training.batches import BatchMaker
from openvima.training.building import training_texts
from openvima.training.config import AugmentationConfig
from openvima.training.learner import PolicyCollate
from small_data_sets import rows_of
from small_networks import rngs_of, source_of_episodes, stack_images

NAMED = (
    "visual_manipulation",
    "rotate",
    "pick_in_order_then_restore",
    "manipulate_old_neighbor",
    "same_shape",
)
KEPT = ("novel_noun", "novel_adj", "rearrange", "twist", "scene_understanding", "follow_order")


@pytest.fixture(scope="module")
def episodes():
    return {task: _episode(task) for task in (*NAMED, *KEPT)}


def _episode(task: str, seed: int = 1):
    return preprocess(rollout_oracle(TabletopEnv(task, level="train", domain="user"), seed), "objects")


def _images(episode) -> dict[str, list]:
    prompt = episode.prompt
    parts = zip(prompt.image_names, prompt.objects.split(prompt.objects_per_image), strict=True)
    return {name: rows_of(table).tolist() for name, table in parts}


@pytest.mark.parametrize("task", ["rotate", "scene_understanding", "novel_adj", "manipulate_old_neighbor"])
def test_a_paraphrase_keeps_images_numbers_and_textures(task, episodes):
    episode, texts = episodes[task], set()
    for seed in range(20):
        said = paraphrase(episode, np.random.default_rng(seed))
        assert _images(said) == _images(episode)
        assert re.findall(r"\b\d+", said.prompt.text) == re.findall(r"\b\d+", episode.prompt.text)
        texts.add(said.prompt.text)
    assert len(texts) > 3
    assert episode.prompt.text not in texts
    other = replace(episodes["rotate"], prompt=replace(episode.prompt, text="Spin it."))
    assert paraphrase(other, np.random.default_rng(0)) is other


def test_the_vocabulary_has_the_words_of_paraphrases(tmp_path):
    folder = generate(GenerateConfig(out=tmp_path / "demos", tasks=("rotate",), episodes=1))
    plain, said = (
        " ".join(training_texts(Dataset(folder), AugmentationConfig(paraphrase_prob=prob)))
        for prob in (0.0, 0.5)
    )
    assert "Twist" in said and "Twist" not in plain
    assert "Brush" not in said  # of another task


@pytest.mark.parametrize("task", NAMED)
def test_renamed_objects_keep_image_and_placeholder(task, episodes):
    episode, with_others = episodes[task], 0
    for seed in range(12):
        named = rename_objects(episode, np.random.default_rng(seed))
        images = _images(named)
        others = [images.pop(name) for name in list(images) if name.startswith("other_")]
        assert images == _images(episode)
        with_others += bool(others)
        for ((_, *numbers_and_boxes),) in others:
            numbers = numbers_and_boxes[:2]
            row = next(row for row in rows_of(episode.objects).tolist() if row[1:3] == numbers)
            assert row[0] not in (episode.pick_ids[0], episode.place_ids[0])
        *definitions, rest = named.prompt.text.split(". ", named.prompt.text.count("This is a "))
        meaning = {}
        for sentence in definitions:
            noun, image = sentence.removeprefix("This is a ").split(" ")
            meaning[noun] = image
        meant = {noun: image for noun, image in meaning.items() if not image.startswith("{other_")}
        assert 1 <= len(meant) <= 2
        assert set(meaning) <= set(NOUNS)
        assert len(meaning) == len(meant) + len(others)
        assert not any(re.search(rf"\b{noun}\b", rest) for noun in set(meaning) - set(meant))
        for noun, image in meant.items():
            assert image not in rest
            rest = rest.replace(f"the {noun}", image).replace(noun, image)
        assert rest.replace("the {", "{") == episode.prompt.text.replace("the {", "{")
    assert bool(with_others) == (task != "rotate" or episode.objects_per_step[0] > 1)


@pytest.mark.parametrize("determiner", ["any", "one", "two", "three", "all"])
def test_a_renamed_object_has_no_article_beside_another_determiner(determiner, episodes):
    episode = episodes["visual_manipulation"]
    text = f"Sweep {determiner} {{dragged_obj}} into {{base_obj}}."
    episode = replace(episode, prompt=replace(episode.prompt, text=text))
    for seed in range(12):
        *_, rest = rename_objects(episode, np.random.default_rng(seed)).prompt.text.split(". ")
        assert re.fullmatch(rf"Sweep {determiner} ({{dragged_obj}}|\w+) into ({{base_obj}}|the \w+)\.", rest)


@pytest.mark.parametrize("task", KEPT)
def test_prompts_with_novel_words_or_without_single_objects_are_unchanged(task, episodes):
    assert rename_objects(episodes[task], np.random.default_rng(0)) is episodes[task]


@pytest.mark.parametrize("task", ["novel_noun", "novel_adj", "visual_manipulation"])
def test_shuffled_sentences_keep_images_and_placeholders(task, episodes):
    seen, examples = set(), set()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        before = rename_objects(episodes[task], rng)
        after = shuffle_sentences(before, rng)
        sentences, images = before.prompt.text.split(". "), _images(before)
        assert all(images[name] == rows for name, rows in _images(after).items())
        assert after.prompt.objects_per_image.sum() == len(after.prompt.objects)
        found = after.prompt.text.removesuffix(".").split(". ")
        of_before = [sentence.removesuffix(".") for sentence in sentences]
        assert set(found) <= set(of_before)
        left_out = set(of_before) - set(found)
        assert all(" than " in sentence for sentence in left_out)
        (instruction,) = (k for k, sentence in enumerate(found) if sentence.startswith("Put "))
        seen.add(instruction)
        examples.add(sum(" than " in sentence for sentence in found))
    assert {0, 1, 2} <= seen
    assert examples == ({1, 2, 3} if task == "novel_adj" else {0})


def test_turned_comparisons_ask_for_the_same_without_less():
    turned = plain = 0
    for seed in range(6):
        episode = _episode("novel_adj", seed)
        after = turn_comparisons(episode, np.random.default_rng(0))
        if "the less " not in episode.prompt.text:
            assert after is episode
            plain += 1
            continue
        assert " less " not in after.prompt.text
        for n in (1, 2, 3):
            more, less = f"{{demo_blicker_obj_{n}}}", f"{{demo_less_blicker_obj_{n}}}"
            assert after.prompt.text.index(less) < after.prompt.text.index(more)
        assert _images(after) == _images(episode)
        turned += 1
    assert turned and plain


def test_an_instruction_of_two_sentences_stays_in_one_piece(episodes):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        text = shuffle_sentences(rename_objects(episodes["pick_in_order_then_restore"], rng), rng).prompt.text
        assert ". Finally restore it into its original container." in text
        assert text.index("Put ") < text.index("Finally")


@pytest.mark.parametrize("task", ["visual_manipulation", "pick_in_order_then_restore"])
def test_only_unused_objects_are_dropped_from_observations_or_prompt_frames(task, episodes):
    motion = with_motion_prompt(episodes[task])
    used = {*motion.pick_ids.tolist(), *motion.place_ids.tolist()}
    bystanders = set(motion.objects.ids.tolist()) - used
    assert bystanders
    unseen, unpictured = set(), set()
    for seed in range(20):
        less = drop_unused_objects(motion, np.random.default_rng(seed), prob=0.5)
        assert less.objects_per_step.sum() == len(less.objects)
        assert less.prompt.objects_per_image.sum() == len(less.prompt.objects)
        assert np.array_equal(less.pick_ids, motion.pick_ids)
        assert np.array_equal(less.place_ids, motion.place_ids)
        out = {
            name: set(table.ids.tolist())
            for name, table in (("view", less.objects), ("pictures", less.prompt.objects))
        }
        gone = [bystanders - out["view"], bystanders - out["pictures"]]
        assert used <= out["view"] and used <= out["pictures"]
        assert not gone[0] & gone[1]
        images = (each.prompt.objects.split(each.prompt.objects_per_image) for each in (less, motion))
        for after, before in zip(*images, strict=True):
            kept = before.select(~np.isin(before.ids, list(gone[1])))
            assert np.array_equal(rows_of(after), rows_of(kept))
        unseen |= gone[0]
        unpictured |= gone[1]
    assert unseen == unpictured == bystanders
    same = drop_unused_objects(motion, np.random.default_rng(0), prob=0.0)
    for ours, theirs in ((same.objects, motion.objects), (same.prompt.objects, motion.prompt.objects)):
        assert np.array_equal(rows_of(ours), rows_of(theirs))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"preset": "gpt-nano", "augmentation.rename_objects_prob": 0.5}, "takes whole frames"),
        ({"preset": "gpt-nano", "augmentation.drop_unused_objects_prob": 0.5}, "takes whole frames"),
        (
            {"preset": "nano", "augmentation.drop_unused_objects_prob": 0.5, "loader.boxes": "detector"},
            "no ids, so unused ones are unknown",
        ),
    ],
)
def test_settings_that_need_objects_and_their_ids_say_so(settings, message, tmp_path):
    config = TrainingConfig.of({"data": tmp_path, "out": tmp_path / "run", **settings})
    with pytest.raises(ConfigError, match=message):
        train(config)


@pytest.mark.parametrize("task", ["follow_order", "novel_adj"])
def test_each_prompt_image_lists_its_objects_in_an_order_of_its_own(task, episodes):
    episode, orders = episodes[task], set()
    for seed in range(5):
        shuffled_episode = shuffle_prompt_objects(episode, np.random.default_rng(seed))
        before, after = _images(episode), _images(shuffled_episode)
        assert {name: sorted(rows) for name, rows in after.items()} == {
            k: sorted(v) for k, v in before.items()
        }
        orders.add(tuple(tuple(before[name].index(row) for row in rows) for name, rows in after.items()))
    if task == "follow_order":
        assert len(orders) == 5
        assert any(len(set(order)) > 1 for order in orders)  # not one permutation for all frames
    else:
        assert orders == {((0,),) * len(before)}


@pytest.mark.parametrize(
    "task", ["rotate", "rearrange", "pick_in_order_then_restore", "sweep_without_exceeding"]
)
def test_centred_picks_are_where_policies_point_and_solve_the_episode_as_well(task) -> None:
    env = TabletopEnv(task, level="train", domain="user")
    for seed in range(2):
        demo = rollout_oracle(env, seed)
        episode = preprocess(demo, "objects")
        centred = augment(episode, AugmentationConfig(centre_picks=True), None)
        env.reset(seed=seed)
        for t, action in enumerate(centred.actions):
            found = observe(env.observe())
            distances = np.linalg.norm(found.positions() - action[:2], axis=1)
            assert found.ids[distances.argmin()] == episode.pick_ids[t]
            assert distances.min() < 1e-6 or episode.end_effector
            _, _, terminated, _, info = env.step(_action(action))
        assert terminated and info["success"]


def _action(numbers: np.ndarray) -> Action:
    pose0, pose1 = np.split(numbers.astype(np.float64), 2)
    arrays = {"pose0_position": pose0[:2], "pose0_rotation": pose0[2:]}
    return Action.from_arrays(arrays | {"pose1_position": pose1[:2], "pose1_rotation": pose1[2:]})


@pytest.mark.parametrize("task", ["novel_noun", "novel_adj", "visual_manipulation", "follow_order"])
@pytest.mark.parametrize("source", ["novel_noun", "novel_adj"])
def test_unused_definitions_come_before_the_instruction_and_define_other_words(task, source, episodes):
    before, other = number_images([episodes[task], episodes[source]])
    words, images, counts, positions = {*NOUNS, *ADJECTIVES}, _images(before), set(), set()
    for seed in range(30):
        after = with_unused_definitions(before, other, np.random.default_rng(seed))
        sentences = after.prompt.text.split(". ")
        own = [sentence for sentence in sentences if "{unused_" not in sentence]
        assert ". ".join(own) == before.prompt.text
        assert all(_images(after)[name] == rows for name, rows in images.items())
        inserted = [sentence for sentence in sentences if sentence not in own]
        there = _images(other)
        for name, rows in _images(after).items():
            assert name in images or rows == there[name.removeprefix("unused_")]
        (instruction,) = (k for k, sentence in enumerate(sentences) if sentence.startswith(("Put", "Stack")))
        assert all(sentences.index(sentence) < instruction for sentence in inserted)
        defined = [(words & {*re.findall(r"\w+", sentence)}).pop() for sentence in inserted]
        assert not set(defined) & {*re.findall(r"\w+", before.prompt.text)}
        assert len(set(defined)) == (1 if source == "novel_adj" else len(defined))
        counts.add(len(inserted))
        positions.update(sentences.index(sentence) for sentence in inserted)
    assert counts == ({1, 2, 3} if source == "novel_adj" else {1, 2})
    assert len(positions) > 1


def test_unused_definitions_are_inserted_in_training_only_with_their_probability(episodes):
    source = source_of_episodes([episodes["novel_adj"], episodes["visual_manipulation"]])
    collate = PolicyCollate(Processor("objects"), 0.0, with_images=True)

    def lengths(prob: float, definers=(0,)) -> list[int]:
        make = BatchMaker(source, collate, 0, 99, definers=definers, unused_definitions_prob=prob)
        return torch.cat([batch.prompts.mask_BL.sum(dim=1) for batch, _ in make(np.arange(2), 4)]).tolist()

    plain = lengths(0.0)
    assert all(more > few for more, few in zip(lengths(1.0), plain, strict=True))
    assert lengths(1.0, definers=()) == plain


@pytest.fixture(scope="module")
def distractor_episodes(episodes):
    tasks = ("rotate", "novel_adj", "novel_noun", "pick_in_order_then_restore", "same_shape", "rearrange")
    return [episodes[task] for task in tasks]


@pytest.fixture(scope="module")
def stacked(distractor_episodes):
    return stack_images(distractor_episodes)


def _rows(table):
    """Each object as a table of its own."""
    return table.split(np.ones(len(table), np.int64))


def _overlap(one, other) -> bool:
    """Whether boxes of two objects overlap in a view that shows both."""
    (centres, sizes), (centres2, sizes2) = (np.split(row.boxes[0], 2, axis=1) for row in (one, other))
    apart = 2 * abs(centres - centres2) >= (sizes + sizes2)[:, ::-1]  # columns by width, rows by height
    return bool((~apart.any(axis=1) & one.masks[0] & other.masks[0]).any())


def test_distractors_overlap_nothing_at_any_step_and_nothing_else_changes(stacked):
    examples, stack = stacked
    added = 0
    for example in examples[:4]:
        for seed, other in enumerate(examples):
            if other is example:
                continue
            numbered = number_images([example.episode, other.episode], [example.base, other.base])
            more = with_distractors(*numbered, np.random.default_rng(seed))
            before, source = example.episode, other.episode
            first = source.objects.split(source.objects_per_step)[0]
            distractors = None
            steps = (each.objects.split(each.objects_per_step) for each in (before, more))
            for ours, theirs in zip(*steps, strict=True):
                assert np.array_equal(theirs.ids[: len(ours)], ours.ids)
                assert np.array_equal(theirs.boxes[: len(ours)], ours.boxes)
                came = theirs.select(slice(len(ours), None))
                assert distractors is None or np.array_equal(rows_of(came), rows_of(distractors))
                distractors = came
                assert not set(came.ids) & set(before.objects.ids)
                assert not any(_overlap(a, b) for a in _rows(came) for b in _rows(ours))
            assert distractors is not None and len(distractors) <= MAX_DISTRACTORS
            added += len(distractors)
            for row in _rows(distractors):
                (origin,) = (
                    k for k in _rows(first) if np.array_equal(k.crop_index + other.base, row.crop_index)
                )
                assert np.array_equal(origin.boxes, row.boxes)
                for number, whole in zip(origin.crop_index[0], row.crop_index[0], strict=True):
                    assert np.array_equal(source.images[number - 1], stack[whole].numpy())
            assert np.array_equal(more.pick_ids, before.pick_ids)
            assert np.array_equal(more.place_ids, before.place_ids)
            assert np.array_equal(more.actions, before.actions)
            assert more.prompt.text == before.prompt.text
            for part in (lambda e: e.prompt.objects, lambda e: e.final, lambda e: e.false_positives):
                own, counted = part(before).crop_index, part(more).crop_index
                assert np.array_equal(np.where(own > 0, own + example.base, 0), counted)
    assert added > 10


def test_distractors_are_inserted_in_training_only_with_their_probability(distractor_episodes):
    collate = PolicyCollate(Processor("objects"), 0.0, with_images=True)

    def counts(share: float) -> torch.Tensor:
        make = BatchMaker(source_of_episodes(distractor_episodes), collate, 0, 99, distractor_prob=share)
        histories = [batch.history for batch, _ in make(np.arange(len(distractor_episodes)), 4)]
        return torch.cat([(each.num_slots_BT * each.steps_BT).sum(dim=1) for each in histories])

    order = np.concatenate(
        source_of_episodes(distractor_episodes).by_length(np.arange(len(distractor_episodes)))
    )
    plain = torch.tensor(
        [
            distractor_episodes[row].objects_per_step.sum() + 2 * distractor_episodes[row].num_steps
            for row in order
        ]
    )
    assert torch.equal(counts(0.0), plain)
    more = counts(1.0) - plain
    receiving = torch.from_numpy(order < 4)  # the last two tasks receive none
    assert (more[~receiving] == 0).all() and (more >= 0).all() and more.sum() > 0


@pytest.mark.parametrize("with_images", [True, False])
def test_a_batch_contains_the_same_images_with_either_indexing(with_images, stacked):
    examples, stack = stacked
    borrowing = [replace(e, other=o) for e, o in zip(examples[:4], examples[2:], strict=True)]
    collate = PolicyCollate(Processor("objects"), 0.0, with_images=with_images)
    batch = collate(borrowing, rngs_of(borrowing))
    images = stack if batch.images is None else batch.images
    for b, example in enumerate(borrowing):
        numbers = batch.history.crop_index_BTVN[b, 0]
        shown = {images[n].numpy().tobytes() for n in numbers.flatten().tolist() if n}
        numbered = number_images([example.episode, example.other.episode], [example.base, example.other.base])
        expected = with_distractors(*numbered, rngs_of(borrowing)[b])
        first = expected.objects.split(expected.objects_per_step)[0]
        assert shown == {stack[n].numpy().tobytes() for n in first.crop_index.flatten() if n}
