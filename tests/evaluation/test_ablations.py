"""What policies get to see under each ablation, which follows from task, level and seed alone."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from openvima.env import EnvConfig, TabletopEnv
from openvima.errors import ConfigError
from openvima.evaluation import EvaluationConfig, Results, evaluate, runner
from openvima.evaluation.ablations import (
    ABLATIONS,
    ablate,
    ablated_environment,
    applies_to,
)
from openvima.evaluation.config import cells, plan
from openvima.evaluation.prompt_ablations import NEUTRAL_PROMPT, gibberish, masked, swapped
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.perception.objects import observe, observe_prompt_image
from openvima.policies import RandomPolicy, load_policy
from openvima.policies.tokenizer import UNKNOWN, Vocabulary, WordTokenizer
from openvima.scene.prompt import PLACEHOLDER
from openvima.tasks import task_spec
from task_cases import REPRESENTATIVE_TASKS, frozen

TEXT = "Put the red counter-clockwise {dragged_obj} into the {base}, then rotate it 30 degrees."
WORDS = {"masked_words:0.5", "swapped_words:0.5", "gibberish_words"}


def generators(count: int):
    return (np.random.default_rng(seed) for seed in range(count))


def words(text: str) -> list[str]:
    return re.findall(r"<unknown>|[\w-]+", PLACEHOLDER.sub("", text))


def begun(task: str, seed: int = 3, level: str | None = None) -> tuple[TabletopEnv, dict]:
    env = TabletopEnv(task, level=level or task_spec(task).levels[-1], domain="eval")
    return env, env.reset(seed=seed)[0]


@pytest.mark.parametrize("rewrite", [masked, swapped, lambda text, _, rng: gibberish(text, rng)])
def test_image_slots_marks_and_their_order_stay(rewrite):
    for rng in generators(20):
        changed = rewrite(TEXT, 0.5, rng)
        assert PLACEHOLDER.findall(changed) == ["dragged_obj", "base"]
        shape = [re.sub(r"<unknown>|[\w-]+", "w", piece) for piece in PLACEHOLDER.split(changed)[::2]]
        assert shape == ["w w w w ", " w w ", ", w w w w w."]


def test_each_word_is_masked_with_the_probability_and_more_at_higher_rates():
    counts = []
    for seed in range(200):
        few, many = (words(masked(TEXT, rate, np.random.default_rng(seed))) for rate in (0.2, 0.6))
        assert all(b == UNKNOWN for a, b in zip(few, many, strict=True) if a == UNKNOWN)
        counts.append((few.count(UNKNOWN), many.count(UNKNOWN)))
    assert np.mean(counts, axis=0) == pytest.approx([0.2 * 11, 0.6 * 11], rel=0.12)


def test_neighbours_are_swapped_with_the_probability_and_never_across_an_image():
    num_swapped = []
    for rng in generators(300):
        changed = PLACEHOLDER.split(swapped(TEXT, 0.2, rng))[::2]
        for own, other in zip(PLACEHOLDER.split(TEXT)[::2], changed, strict=True):
            assert sorted(words(own)) == sorted(words(other))
        num_swapped.append(words(changed[1]) != ["into", "the"])
    assert np.mean(num_swapped) == pytest.approx(0.2, abs=0.07)
    assert swapped("a b c d", 1, np.random.default_rng(0)) == "b c d a"


def test_gibberish_keeps_lengths_and_says_one_word_always_alike():
    text = "The red block, the RED blocks: {a} counter-clockwise 30"
    seen = set()
    for rng in generators(10):
        changed = words(gibberish(text, rng))
        assert [len(word) for word in changed] == [len(word) for word in words(text)]
        assert changed[0].lower() == changed[3] and changed[1] == changed[4].lower()
        assert changed[0][0].isupper() and changed[-1] == "30" and changed[-2][7] == "-"
        seen.add(changed[1])
    assert len(seen) == 10


def test_a_masked_word_is_the_unknown_token_of_a_vocabulary_or_left_out():
    with_unknown, without = Vocabulary((UNKNOWN, "put", ".")), Vocabulary(("put", "."))
    ids = WordTokenizer(with_unknown)
    assert ids.encode("put <unknown>.") == [*ids.encode("put"), with_unknown.ids()[UNKNOWN], *ids.encode(".")]
    assert WordTokenizer(without).encode("put <unknown>.") == WordTokenizer(without).encode("put.")
    assert without.extended(["put <unknown> there"]).words == ("put", ".", "there")


def test_the_attribute_of_a_comparison_is_swapped_and_nothing_else():
    for task, level, other in (("same_texture", "L4", "profile"), ("same_shape", "L1", "texture")):
        env = TabletopEnv(task, level=level, domain="user", prompts="text")
        env.reset(seed=0)
        own, text = env.prompt.text.split(), ablate(env, "swapped_attribute").prompt.text.split()
        assert [(a, b) for a, b in zip(own, text, strict=True) if a != b] == [(own[6], other)]
    config = EvaluationConfig(("untrained",), episodes=1)
    of = {task for task, _ in cells(config, "swapped_attribute")}
    assert of == {"same_texture", "same_shape"}


def test_each_prompt_image_lists_its_objects_in_an_order_of_its_own():
    (env, _), orders = begun("follow_order"), set()
    changed = ablate(env, "shuffled_prompt_objects").prompt
    assert changed.text == env.prompt.text
    for name, image in env.prompt.images.items():
        listed = changed.images[name].objects
        assert sorted(map(str, listed)) == sorted(map(str, image.objects))
        assert changed.images[name].segm is image.segm
        orders.add(tuple(image.objects.index(record) for record in listed))
    assert len(orders) > 1


class Noting(RandomPolicy):
    """Notes what it is told and shown; its actions depend on nothing."""

    def reset(self, prompts):
        super().reset([type(prompt)("", {}) for prompt in prompts])
        self.prompts, self.segms = prompts, []

    def act(self, observations):
        self.segms += [seen["segm"]["top"] for seen in observations if seen is not None]
        return super().act(observations)


@pytest.mark.parametrize("ablation", sorted(WORDS))
def test_words_follow_from_the_episode_and_change_nothing_for_who_ignores_them(ablation):
    (env, _), policy = begun("twist", level="L1"), Noting()
    (plain,) = play([env], [3], PromptedRolloutPolicy(policy))
    (corrupted,) = play([env], [3], PromptedRolloutPolicy(policy, ablation))
    assert corrupted == plain
    alone = policy.prompts[0].text
    assert alone != env.prompt.text
    others = [begun("twist", seed, "L1")[0] for seed in (7, 3)]
    play(others, [7, 3], PromptedRolloutPolicy(policy, ablation))
    assert policy.prompts[1].text == alone != policy.prompts[0].text
    assert policy.prompts[1].images == others[1].prompt.images


def test_several_at_once_are_one_ablation_in_one_spelling():
    env, _ = begun("visual_manipulation")
    both = ablate(env, "masked_words:0.5+noisy_boxes:3")
    assert both.prompt.text == ablate(env, "masked_words:0.5").prompt.text
    assert both.jitter is not None
    config = EvaluationConfig(
        ("mine=a",), ablations=("masked_words:.2", "masked_words:0.20", "noisy_boxes:3+masked_words:.50")
    )
    assert config.ablations == ("masked_words:0.2", "masked_words:0.5+noisy_boxes:3")
    assert config.record()["ablations"] == list(config.ablations)


def test_moved_boxes_follow_from_the_episode_and_change_the_actions_of_networks_on_objects():
    pytest.importorskip("torch")
    (env, observation), (nano, random) = begun("rearrange"), (load_policy("untrained:nano"), Noting())
    acted = []
    for ablation in ("", "noisy_boxes:8", "noisy_boxes:8"):
        seen = ablate(env, ablation)
        nano.reset([seen.prompt])
        acted.append(
            [nano.act([seen.observation(observation)])[0]["pose0_position"].tolist() for _ in range(2)]
        )
    assert acted[1] == acted[2] and acted[1] != acted[0]
    outcomes = [play([env], [3], PromptedRolloutPolicy(random, a)) for a in ("", "noisy_boxes:8")]
    assert outcomes[0] == outcomes[1]


@pytest.mark.parametrize(
    ("ablation", "message"),
    [
        ("masked_word:0.2", "Did you mean 'masked_words'"),
        ("masked_words", "write masked_words:0.2, with a number from 0 to 1"),
        ("masked_words:-1", "a number from 0 to 1"),
        ("masked_words:1.5", "a number from 0 to 1"),
        ("masked_words:nan", "a number from 0 to 1"),
        ("noisy_boxes:2.5", "an integer from 1 to 32"),
        ("num_distractors:99", "an integer from 0 to 6"),
        ("gibberish_words:0.2", r"write gibberish_words\."),
        ("no_prompt+random", "and alone all, random, oracle"),
        ("text_prompts+paraphrased_prompts", "exclude each other"),
        ("detected_boxes+noisy_boxes:3", "exclude each other"),
        ("masked_words:0.2+masked_words:0.4", "exclude each other"),
        ("swapped_attribute+held_out_phrasings", "exclude each other"),
    ],
)
def test_ablations_that_cannot_be_are_refused_in_one_line(ablation, message):
    with pytest.raises(ConfigError, match=message) as found:
        EvaluationConfig(("untrained",), ablations=(ablation,))
    assert "\n" not in str(found.value)


def test_environments_change_for_the_tasks_that_have_the_form_or_the_option():
    plain = EnvConfig(task_options="num_distractors=1,rotate.num_distractors=2,rotate.difficulty=medium")
    assert ablated_environment("text_prompts", plain).prompts == "text"
    assert (
        ablated_environment("paraphrased_prompts", EnvConfig(prompts="mixed")).prompts == "mixed,paraphrased"
    )
    crowded = ablated_environment("num_distractors:6", plain)
    assert crowded.task_options == "num_distractors=6,rotate.difficulty=medium"
    assert ablated_environment("masked_words:0.2", plain) == plain
    assert applies_to("num_distractors:6", "rotate", crowded)
    config = EvaluationConfig(
        ("untrained",), ("rotate", "rearrange", "pick_in_order_then_restore"), ("L1",), 1
    )
    tasks = {
        ablation: [task for task, _ in cells(config, ablation)]
        for ablation in ("", "text_prompts", "num_distractors:2", "num_distractors:6+masked_words:0.1")
    }
    assert list(tasks.values()) == [
        ["rotate", "rearrange", "pick_in_order_then_restore"],
        ["rotate", "pick_in_order_then_restore"],
        ["rotate", "rearrange"],
        ["rotate", "rearrange"],
    ]
    asked = EvaluationConfig(("untrained",), ("rotate", "rearrange"), ("L1",), 1, ablations=("text_prompts",))
    assert [(b.ablation, b.task, b.env_config.prompts) for b in plan(asked)] == [
        ("", "rotate", "multimodal"),
        ("", "rearrange", "multimodal"),
        ("text_prompts", "rotate", "text"),
    ]


def test_an_ablation_that_fits_no_task_is_an_error():
    with pytest.raises(
        ConfigError, match=r"text_prompts applies to none of the tasks rearrange; it does to .*rotate"
    ):
        cells(EvaluationConfig(("untrained",), ("rearrange",)), "text_prompts")


@pytest.mark.parametrize("prompts", ["text", "mixed"])
def test_descriptions_are_of_another_episode_where_images_would_be(prompts):
    env = TabletopEnv("visual_manipulation", level="L2", domain="eval", prompts=prompts)
    num_other = 0
    for seed in range(5):
        env.reset(seed=seed)
        borrowed = ablate(env, "other_prompt_images").prompt
        assert list(borrowed.images) == list(env.prompt.images)
        assert borrowed.text.startswith("Put the ") and borrowed.text.count("{") == len(borrowed.images)
        num_other += frozen(borrowed) != frozen(env.prompt)
    assert num_other == 5


@pytest.mark.parametrize("task", REPRESENTATIVE_TASKS)
def test_ablations_of_one_episode_are_equal_whenever_they_are_drawn(task):
    env, _ = begun(task)
    drawn = {ablation: ablate(env, ablation) for ablation in ABLATIONS}
    begun(task, seed=4)
    env, _ = begun(task)
    for ablation, first in reversed(drawn.items()):
        again = ablate(env, ablation)
        assert frozen(first.prompt) == frozen(again.prompt)
        assert np.array_equal(first.id_map, again.id_map)
        WordTokenizer().encode(" ".join(piece for piece in again.prompt.sequence() if isinstance(piece, str)))


def test_images_of_another_episode_stand_in_the_words_of_this_one():
    env, _ = begun("visual_manipulation", level="L3")
    changed = ablate(env, "other_prompt_images").prompt
    assert changed.text == env.prompt.text
    assert list(changed.images) == list(env.prompt.images)
    assert not any(
        np.array_equal(changed.images[name].rgb["front"], image.rgb["front"])
        for name, image in env.prompt.images.items()
    )


def test_scrambled_words_leave_images_and_their_order():
    env, _ = begun("twist")
    changed = ablate(env, "scrambled_words").prompt
    assert changed.images == env.prompt.images
    shown = [[part.name for part in p.sequence() if not isinstance(part, str)] for p in (changed, env.prompt)]
    assert shown[0] == shown[1]
    assert changed.text.split() != env.prompt.text.split()
    assert not any(character in changed.text for character in ".:,")
    other = ablate(begun("twist", seed=4)[0], "scrambled_words").prompt
    assert changed.text != other.text


@pytest.mark.parametrize(
    "task", ["visual_manipulation", "rearrange", "follow_order", "sweep_without_exceeding"]
)
def test_shuffled_objects_change_ids_and_nothing_that_can_be_seen(task):
    env, observation = begun(task)
    changed = ablate(env, "shuffled_objects")
    seen = changed.observation(observation)
    plain, shuffled = observe(observation), observe(seen)
    assert sorted(plain.ids) == sorted(shuffled.ids)
    assert np.array_equal(plain.crops, shuffled.crops)
    assert seen["rgb"] is observation["rgb"]
    for name, image in env.prompt.images.items():
        views = observe_prompt_image(image), observe_prompt_image(changed.prompt.images[name])
        assert np.array_equal(views[0].crops, views[1].crops)
        assert np.array_equal(views[0].boxes, views[1].boxes)


def test_ids_are_dealt_out_differently_in_other_episodes():
    deals = set()
    for seed in range(8):
        env, observation = begun("rearrange", seed=seed, level="L1")
        ids = observe(ablate(env, "shuffled_objects").observation(observation)).ids
        deals.add(tuple(ids != observe(observation).ids))
    assert len(deals) > 1
    assert any(any(deal) for deal in deals)


def test_shuffled_objects_keep_their_new_ids_through_an_episode_and_its_images():
    env, observation = begun("follow_order")
    changed = ablate(env, "shuffled_objects")
    again = changed.observation({**observation, "ee": 0})
    assert np.array_equal(again["segm"]["top"], changed.observation(observation)["segm"]["top"])
    pairs = {
        (old.object_id, new.object_id)
        for name, image in env.prompt.images.items()
        for old, new in zip(image.objects, changed.prompt.images[name].objects, strict=True)
        if image.kind == "scene"
    }
    assert len(pairs) == len({old for old, _ in pairs}) == len({new for _, new in pairs})


def test_the_environment_is_left_as_it_was():
    env, _ = begun("rearrange")
    untouched, _ = begun("rearrange")
    for ablation in ABLATIONS:
        ablate(env, ablation)
    assert env.scene == untouched.scene
    assert frozen(env.prompt) == frozen(untouched.prompt)


def test_players_show_policies_what_the_ablation_leaves():
    envs = [begun("visual_manipulation")[0] for _ in range(2)]
    noting = Noting()
    play(envs, [5, 6], PromptedRolloutPolicy(noting, "no_prompt"))
    assert noting.prompts == [NEUTRAL_PROMPT] * 2 and NEUTRAL_PROMPT.sequence() == ["."]
    play(envs, [5, 6], PromptedRolloutPolicy(noting, "shuffled_objects"))
    for env, seed, shown in zip(envs, (5, 6), noting.segms, strict=False):
        observation, _ = env.reset(seed=seed)
        assert np.array_equal(shown, ablate(env, "shuffled_objects").observation(observation)["segm"]["top"])


EXTRACTORS = Path(__file__).parents[1] / "plugged_extractors.py"
CONFIG = EvaluationConfig(
    ("untrained",),
    ("visual_manipulation",),
    ("L1",),
    episodes=2,
    ablations=("detected_boxes",),
    boxes="x:y",
)


@pytest.fixture
def rows(tmp_path: Path):
    """Play with a detector; returns the plain outcomes and those with its boxes."""
    pytest.importorskip("torch")

    def played(boxes: str):
        results = Results.read(evaluate(replace(CONFIG, boxes=boxes, out=tmp_path / "out")))
        return [row.outcomes for row in results.rows]

    return played


def test_a_detector_that_finds_what_the_segmentation_says_changes_nothing(rows):
    plain, detected = rows(f"{EXTRACTORS}:truth")
    assert detected == plain


def test_a_detector_that_finds_nothing_fails_its_episodes_and_stops_nobody(rows):
    _, detected = rows(f"{EXTRACTORS}:Blind")
    assert [outcome.success for outcome in detected] == [False, False]


def test_a_missing_detector_is_named_before_anything_is_played(tmp_path):
    with pytest.raises(ConfigError, match="no such module"):
        evaluate(replace(CONFIG, boxes="no_such_module:make", out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_an_edited_detector_plays_its_batches_again_and_no_others(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    file, played = tmp_path / "mine.py", []
    file.write_text("from plugged_extractors import truth as make")
    config = replace(CONFIG, boxes=f"{file}:make", out=tmp_path / "out", episodes=1)
    play_batch = runner.play_batch

    def noting(batch, count):
        played.append(batch.ablation)
        return play_batch(batch, count)

    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "play_batch", noting)
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(runner, "write_actions", interrupted)
        evaluate(config)
    file.write_text("from plugged_extractors import Blind as make")
    rows = Results.read(evaluate(config)).rows
    assert played == ["", "detected_boxes", "detected_boxes"]
    assert [row.outcomes[0].success for row in rows] == [rows[0].outcomes[0].success, False]
    file.write_text("from plugged_extractors import truth as make")
    with pytest.raises(ConfigError, match="holds another evaluation"):
        evaluate(config)
