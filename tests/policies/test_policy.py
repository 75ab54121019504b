"""The contract of policies: valid actions for running episodes, whatever the other episodes do."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from openvima.policies import RandomPolicy, load_policy
from openvima.policies.base import Policy
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
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


def test_the_random_policy_follows_from_its_seed_and_never_touches_the_global_generator(
    demonstrations,
) -> None:
    state = np.random.get_state()[1].copy()
    drawn = [played(load_policy("random", seed=seed), demonstrations, [0])[0] for seed in (5, 5, 6)]
    assert_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0][0]["pose0_position"], drawn[2][0]["pose0_position"])
    assert (np.random.get_state()[1] == state).all()
