"""What policies get to see under each ablation, and that it follows from task, level and seed alone."""

import numpy as np
import pytest

from openvima.env import TabletopEnv
from openvima.evaluation.ablations import ABLATIONS, ablate
from openvima.evaluation.prompt_ablations import NEUTRAL_PROMPT
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.perception.objects import observe, observe_prompt_image
from openvima.policies import RandomPolicy
from openvima.policies.tokenizer import WordTokenizer
from openvima.scene import RenderedPrompt
from openvima.tasks import task_spec
from task_cases import REPRESENTATIVE_TASKS


def begun(task: str, seed: int = 3, level: str | None = None) -> tuple[TabletopEnv, dict]:
    env = TabletopEnv(task, level=level or task_spec(task).levels[-1], domain="eval")
    return env, env.reset(seed=seed)[0]


def same(a: RenderedPrompt, b: RenderedPrompt) -> bool:
    """Whether two prompts are equal to the last pixel."""
    return (
        a.text == b.text
        and list(a.images) == list(b.images)
        and all(
            a.images[name].objects == b.images[name].objects
            and all(
                np.array_equal(getattr(a.images[name], part)[view], getattr(b.images[name], part)[view])
                for part in ("rgb", "segm")
                for view in ("front", "top")
            )
            for name in a.images
        )
    )


@pytest.mark.parametrize("prompts", ["text", "mixed"])
def test_descriptions_are_of_another_episode_where_images_would_be(prompts):
    env = TabletopEnv("visual_manipulation", level="L2", domain="eval", prompts=prompts)
    num_other = 0
    for seed in range(5):
        env.reset(seed=seed)
        borrowed = ablate(env, "other_prompt_images").prompt
        assert list(borrowed.images) == list(env.prompt.images)
        assert borrowed.text.startswith("Put the ") and borrowed.text.count("{") == len(borrowed.images)
        num_other += not same(borrowed, env.prompt)
    assert num_other == 5


@pytest.mark.parametrize("task", REPRESENTATIVE_TASKS)
def test_ablations_of_one_episode_are_equal_whenever_they_are_drawn(task):
    env, _ = begun(task)
    for ablation in ABLATIONS:
        first = ablate(env, ablation)
        TabletopEnv(task, level=env.level, domain="eval").reset(seed=4)
        again = ablate(begun(task)[0], ablation)
        assert same(first.prompt, again.prompt)
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
    assert same(env.prompt, untouched.prompt)


class Noting(RandomPolicy):
    """Notes what it is told and shown."""

    def reset(self, prompts):
        super().reset(prompts)
        self.prompts, self.segms = prompts, []

    def act(self, observations):
        self.segms += [seen["segm"]["top"] for seen in observations if seen is not None]
        return super().act(observations)


def test_players_show_policies_what_the_ablation_leaves():
    envs = [begun("visual_manipulation")[0] for _ in range(2)]
    noting = Noting()
    play(envs, [5, 6], PromptedRolloutPolicy(noting, "no_prompt"))
    assert noting.prompts == [NEUTRAL_PROMPT] * 2 and NEUTRAL_PROMPT.sequence() == ["."]
    play(envs, [5, 6], PromptedRolloutPolicy(noting, "shuffled_objects"))
    for env, seed, shown in zip(envs, (5, 6), noting.segms, strict=False):
        observation, _ = env.reset(seed=seed)
        assert np.array_equal(shown, ablate(env, "shuffled_objects").observation(observation)["segm"]["top"])
