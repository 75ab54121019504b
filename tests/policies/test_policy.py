"""The contract of policies: valid actions for running episodes, whatever the other episodes do."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from naive_inputs import NaiveProcessor, batch_histories, batch_prompts
from openvima.policies import RandomPolicy, load_policy
from openvima.policies.base import Policy
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.action_head import shift_actions
from openvima.policies.nn.actions import ActionTargets
from openvima.scene import ACTION_SHAPES, WORKSPACE_HIGH, WORKSPACE_LOW


@pytest.fixture(params=["random", "pointer", "bins", "published"])
def policy(request, small_sizes, small_bins_sizes) -> Policy:
    if request.param == "random":
        return RandomPolicy(seed=1)
    if request.param == "pointer":
        network = build_network(small_sizes, seed=2)
        # Offsets start at zero and would hide differences.
        torch.nn.init.constant_(network.head.offset.weight, 0.02)
        return NetworkPolicy(network)
    sizes = small_bins_sizes
    if request.param == "published":
        objects = replace(sizes.images, fuse_views=False, appearance_width=0)
        sizes = replace(sizes, images=objects, query_token=False)
    return NetworkPolicy(build_network(sizes, seed=2))


def played(policy: Policy, episodes, rows, num_steps: int = 3) -> dict[int, list]:
    """Actions of some of the episodes, played together in the order of `rows`."""
    policy.reset([episodes[row].prompt for row in rows])
    actions: dict[int, list] = {row: [] for row in rows}
    for step in range(num_steps):
        seen = [episodes[row].observation(step) if step <= episodes[row].num_steps else None for row in rows]
        decided = policy.act(seen)
        assert len(decided) == len(rows)
        for row, observation, action in zip(rows, seen, decided, strict=True):
            assert (action is None) == (observation is None)
            if action is not None:
                actions[row].append(action)
    return actions


def assert_equal(one: list, other: list) -> None:
    assert len(one) == len(other)
    for first, second in zip(one, other, strict=True):
        for key in ACTION_SHAPES:
            np.testing.assert_array_equal(first[key], second[key])


def test_actions_are_four_float32_arrays_within_bounds(policy, demonstrations) -> None:
    for actions in played(policy, demonstrations, range(len(demonstrations))).values():
        for action in actions:
            assert {key: value.shape for key, value in action.items()} == {
                key: (length,) for key, length in ACTION_SHAPES.items()
            }
            assert all(value.dtype == np.float32 for value in action.values())
            for key in ("pose0_position", "pose1_position"):
                assert (action[key] >= np.float32(WORKSPACE_LOW)).all()
                assert (action[key] <= np.float32(WORKSPACE_HIGH)).all()
            for key in ("pose0_rotation", "pose1_rotation"):
                assert (np.abs(action[key]) <= 1).all()


def encode_episode(processor: NaiveProcessor, demo) -> list:
    episode = processor.start_episode()
    return [episode.encode_step(demo.observation(t)) for t in range(demo.num_steps)]


def test_padding_changes_nothing(small_sizes, demonstrations) -> None:
    """The same prompt and steps, alone and beside longer ones, give the head the same inputs."""
    model = build_network(small_sizes, seed=4).double().eval()
    chosen = [demonstrations[0], demonstrations[-1]]
    processor = NaiveProcessor.of(small_sizes.inputs)
    prompts = [processor.encode_prompt(demo.prompt) for demo in chosen]
    steps = [encode_episode(processor, demo) for demo in chosen]

    def run(rows: list[int]):
        crops, numbers, histories, first = [], [], [], 0
        for row in rows:
            numbers.append(first + np.arange(2 * len(prompts[row].objects)).reshape(2, -1))
            crops.append(prompts[row].objects.crops.reshape(-1, 3, 32, 32))
            first += len(crops[-1])
            histories.append([])
            for step in steps[row]:
                histories[-1].append(first + np.arange(2 * len(step.objects)).reshape(2, -1))
                crops.append(step.objects.crops.reshape(-1, 3, 32, 32))
                first += len(crops[-1])
        features = model.encode_images(torch.from_numpy(np.concatenate(crops)))
        prompt = model.encode_prompt(batch_prompts([prompts[row] for row in rows], numbers), features)
        history = batch_histories([steps[row] for row in rows], histories)
        actions = torch.full((*history.steps_BT.shape, 12), 0.3, dtype=torch.float64)
        no_slots = torch.full_like(history.num_slots_BT, -1)
        previous = shift_actions(ActionTargets(actions, no_slots, no_slots, history.steps_BT))
        given = []
        hook = model.head.pick.register_forward_pre_hook(lambda _, arguments: given.extend(arguments))
        model.decode_step(prompt, model.init_cache(prompt), history, features, *previous)
        hook.remove()
        (inputs,) = given
        return prompt, inputs

    with torch.no_grad():
        both, padded = run([0, 1])
        for row in (0, 1):
            prompt, alone = run([row])
            length, count = len(prompts[row].words), alone.masks_BTN.shape[2]
            torch.testing.assert_close(both.tokens_BLD[row, :length], prompt.tokens_BLD[0])
            assert not both.mask_BL[row, length:].any()
            exists = alone.masks_BTN[0]
            num_steps = len(steps[row])
            torch.testing.assert_close(padded.query_BTD[row, :num_steps], alone.query_BTD[0])
            torch.testing.assert_close(
                padded.objects_BTND[row, :num_steps, :count][exists], alone.objects_BTND[0][exists]
            )
            assert not padded.masks_BTN[row, num_steps:].any()
            assert not padded.masks_BTN[row, :, count:].any()


def test_the_random_policy_follows_from_its_seed_and_never_touches_the_global_generator(
    demonstrations,
) -> None:
    state = np.random.get_state()[1].copy()
    drawn = [played(load_policy("random", seed=seed), demonstrations, [0])[0] for seed in (5, 5, 6)]
    assert_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0][0]["pose0_position"], drawn[2][0]["pose0_position"])
    assert (np.random.get_state()[1] == state).all()
