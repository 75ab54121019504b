"""The pointer model: what its head reads, what it keeps of an episode, and what must not matter."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.action_head import shift_actions
from openvima.policies.nn.actions import ACTION_PARTS, ACTION_WIDTH
from openvima.policies.nn.policy_network import PolicyNetwork, StepInputs
from openvima.policies.pointer.inputs import HeadInputs, ObjectSet
from openvima.policies.processor import Processor
from openvima.policies.tokenizer import benchmark_vocabulary
from small_networks import (
    collate_examples,
    examples_of,
    narrow_small,
    perturbed,
)

assert_close = partial(torch.testing.assert_close, rtol=1e-5, atol=1e-6)  # actions taken are float32
TASKS = ("rearrange_then_restore", "follow_order", "twist", "visual_manipulation", "scene_understanding")


@pytest.fixture(scope="module")
def demos() -> list[Demonstration]:
    """One of each task, of one to several steps."""
    runs = [rollout_oracle(TabletopEnv(task, level="train", domain="user"), 1) for task in TASKS]
    assert {run.num_steps for run in runs} >= {1, 2}
    return runs


@pytest.fixture(scope="module")
def network() -> PolicyNetwork:
    return perturbed("small").double()


@torch.no_grad()
def read_whole(network: PolicyNetwork, demos, taken_BTC=None) -> tuple[HeadInputs, "torch.Tensor"]:
    """Inputs of the head for all steps of some demonstrations, and what it decodes.

    Actions are those of the demonstrations, or others that were taken.
    """
    processor = Processor(*network.config.inputs)
    examples, images = examples_of(demos, processor)
    batch = collate_examples(processor, examples)
    features = network.encode_images(images)
    prompt = network.encode_prompt(batch.prompts, features)
    actions_BTC = batch.targets.actions_BTC if taken_BTC is None else taken_BTC
    previous = shift_actions(replace(batch.targets, actions_BTC=actions_BTC))
    step = StepInputs(prompt, network.init_cache(prompt), batch.history, features, *previous)
    inputs, _ = network._head_inputs(step)
    return inputs, network.head.decode(inputs)


def test_acting_in_a_batch_decides_what_reading_whole_histories_does(network, demos):
    policy, several = NetworkPolicy(network), [demo for demo in demos if demo.num_steps > 1]
    policy.reset([demo.prompt for demo in several])
    given: list[HeadInputs] = []
    hook = policy.network.head.pick.register_forward_pre_hook(lambda _, arguments: given.append(*arguments))
    taken = torch.zeros(len(several), max(demo.num_steps for demo in several), 12)
    for t in range(taken.shape[1]):
        observations = [demo.observation(t) if t < demo.num_steps else None for demo in several]
        for b, action in enumerate(policy.act(observations)):
            if action is not None:
                taken[b, t] = torch.from_numpy(np.concatenate([action[key] for key in ACTION_PARTS]))
    hook.remove()
    inputs, decided = read_whole(network, several, taken)
    for t, now in enumerate(given):
        assert now.steps_BT.unique().tolist() == [t]
        for row, b in enumerate(b for b, demo in enumerate(several) if t < demo.num_steps):
            exist = now.masks_BTN[row, 0]
            assert_close(now.query_BTD[row, 0], inputs.query_BTD[b, t])
            assert_close(now.objects_BTND[row, 0][exist], inputs.objects_BTND[b, t, : len(exist)][exist])
            for one, all_of_them in (
                (now.first_step, inputs.first_step),
                (now.prompt.objects, inputs.prompt.objects),
            ):
                exist = one.masks_BK[row]
                assert all_of_them.masks_BK[b].sum() == exist.sum()
                for name in ObjectSet.__slots__:
                    expected = getattr(all_of_them, name)[b, : len(exist)]
                    assert_close(getattr(one, name)[row][exist], expected[exist])
    others = read_whole(network, several, taken.roll(1, 0))[0]
    for b, demo in enumerate(several):
        steps = slice(demo.num_steps)
        torch.testing.assert_close(decided[b, steps].float(), taken[b, steps])
        torch.testing.assert_close(inputs.previous_BTC[b, 1 : demo.num_steps], taken[b, : demo.num_steps - 1])
        assert (inputs.previous_BTC[b, 0] == 0).all()
        assert (inputs.previous_BTC[b, demo.num_steps :] == 0).all()
    # Other actions before it, with the tokens as they were: other scores.
    mixed = replace(inputs, previous_BTC=others.previous_BTC)
    changed = (network.head.pick(mixed) - network.head.pick(inputs)).abs().amax(-1)
    assert (changed[:, 0] == 0).all()
    assert (changed[:, 1] > 1e-6).all()


def test_the_first_step_is_kept_and_images_of_single_objects_are_no_candidates(network, demos):
    inputs, _ = read_whole(network, demos)
    first, scenes = inputs.first_step, inputs.prompt.objects
    assert torch.equal(first.positions_BK2, inputs.positions_BTN2[:, 0])
    assert torch.equal(first.masks_BK, inputs.masks_BTN[:, 0])
    shown = {task: scenes.masks_BK[b].sum().item() for b, task in enumerate(TASKS)}
    records = [sum(len(image.objects) for image in demo.prompt.images.values()) for demo in demos]
    assert shown == {**dict(zip(TASKS, records, strict=True)), "visual_manipulation": 0}


def test_positions_keep_float32_in_half_precision(demos):
    inputs, decided = read_whole(perturbed("small").bfloat16(), demos)
    for positions in (inputs.first_step.positions_BK2, inputs.prompt.objects.positions_BK2):
        assert positions.dtype == torch.float32
    assert decided.isfinite().all()


def test_sessions_have_states_of_their_own(network, demos):
    policy = NetworkPolicy(network)
    other = policy.new_session()
    long, another = demos[0], demos[1]
    policy.reset([long.prompt])
    first = policy.act([long.observation(0)])
    other.reset([another.prompt, long.prompt])
    other.act([another.observation(0), long.observation(1)])
    other.act([None, long.observation(0)])
    second = policy.act([long.observation(1)])
    policy.reset([another.prompt, long.prompt])
    for t, expected in ((0, first), (1, second)):
        got = policy.act([another.observation(t), long.observation(t)])[1]
        for key, value in expected[0].items():
            np.testing.assert_array_equal(got[key], value)


def test_without_correspondence_it_copies_places_but_estimates_no_rotations(demos):
    network = perturbed(replace(narrow_small(), correspondence=None)).double()
    inputs, decided = read_whole(network, demos)
    assert inputs.prompt.objects.rotations_BKR.shape[-1] == 0
    assert decided.isfinite().all()


def test_rotations_of_objects_in_view_lead_to_how_the_prompt_shows_them(network, demos, monkeypatch):
    """An object that was turned by 30 degrees since the prompt's image has to turn back, by 330."""
    original = network.prompt_correspondence.forward

    def turned(*given):
        changes_BTND, rotations_BTNR = original(*given)
        return changes_BTND, torch.eye(72)[6].expand_as(rotations_BTNR)

    monkeypatch.setattr(network.prompt_correspondence, "forward", turned)
    inputs, _ = read_whole(network, demos)
    assert (inputs.rotations_BTNR.argmax(dim=-1) == 66).all()


def test_images_of_single_objects_do_not_change_the_correspondence_of_scenes(network, demos):
    """Following a motion is the same task whether or not the prompt also names the object that moves."""
    frames, alone = demos[1].prompt, demos[3].prompt.images["base_obj"]
    with_object = replace(
        frames, text=f"{{base_obj}} {frames.text}", images={"base_obj": alone, **frames.images}
    )
    encoded = []
    for prompt in (frames, with_object):
        batch, stack = Processor(*network.config.inputs).encode_prompts([prompt])
        with torch.no_grad():
            features = network.encode_images(torch.from_numpy(stack.images()))
            prompt = network.encode_prompt(batch, features)
            changes, rotations = network._changes_in_prompt(prompt.features)
        encoded.append((prompt.objects.image_index_BK, rotations, changes))
    for before, after in zip(*encoded, strict=True):
        torch.testing.assert_close(after[:, 1:], before)
    assert encoded[0][0].max() == len(frames.images) - 1


def test_a_prompt_without_images_is_possible(network, demos):
    demo = demos[3]
    processor = Processor(*network.config.inputs)
    prompt = replace(demo.prompt, text="Rotate it 30 degrees.", images={})
    batch, stack = processor.encode_prompts([prompt])
    history, stack = processor.encode_observations([[demo.observation(0)]], stack=stack)
    features = network.encode_images(torch.from_numpy(stack.images()))
    encoded = network.encode_prompt(batch, features)
    previous = torch.zeros(1, 1, ACTION_WIDTH), torch.zeros(1, 1, dtype=torch.bool)
    step = StepInputs(encoded, network.init_cache(encoded), history, features, *previous)
    actions, _ = network.decode_step(step)
    assert actions.isfinite().all()


def test_names_of_textures_change_text_appearance_and_not_the_masked_encoding(network, demos):
    prompt = demos[4].prompt
    first, rest = prompt.text.removeprefix("Put the ").split(" object in ", 1)
    prompts = []
    for named in (first, *(("green", "purple") if first != "green" else ("purple", "green"))):
        named_prompt = replace(prompt, text=f"Put the {named} object in {rest}")
        batch, stack = Processor(*network.config.inputs).encode_prompts([named_prompt])
        with torch.no_grad():
            features = network.encode_images(torch.from_numpy(stack.images()))
            prompts.append(network.encode_prompt(batch, features))
    _, green, purple = prompts
    torch.testing.assert_close(green.masked_BLD, purple.masked_BLD)
    assert (green.tokens_BLD - purple.tokens_BLD).abs().max() > 1e-3
    assert (green.text_appearance_BLA - purple.text_appearance_BLA).abs().amax(-1).nonzero().tolist() == [
        [0, 2]
    ]
    names = [word for word in re.split(r"\W+", rest) if word in benchmark_vocabulary().texture_words]
    assert green.text_appearance_BLA.abs().amax(-1).count_nonzero() == 1 + len(
        names
    )  # no other word has an appearance


def test_words_of_textures_are_those_that_name_them_alone():
    words = set(benchmark_vocabulary().texture_words)
    assert {"blue", "stripe", "polka", "dot", "paisley", "tiles", "dark"} <= words
    assert not words & {"and", "object", "the", "texture", "wug", "kobar", "darker"}
