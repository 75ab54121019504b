"""Policies report which of their actions rounding may have changed."""

import numpy as np
import pytest
import torch

from openvima.policies import preset
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.policy_network import PolicyNetwork
from small_networks import narrow_small


def decisive(name: str) -> PolicyNetwork:
    """A network whose classes score far apart; fresh heads score them all alike."""
    network = build_network(narrow_small() if name == "small" else preset(name), seed=3)
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return network


@pytest.mark.parametrize(
    ("name", "last_layer"),
    [("nano", "yaw"), ("small", "yaw"), ("nano-bins", "classifiers.5.4"), ("midas-nano", "classifiers.11.4")],
)
def test_classes_that_score_alike_are_a_near_tie(name, last_layer, starts):
    envs, observations = zip(*starts, strict=True)
    network = decisive(name)
    policy = NetworkPolicy(network)
    assert policy.near_ties == []
    policy.reset([env.prompt for env in envs])
    assert policy.near_ties == [False] * len(envs)
    policy.act(observations)
    assert policy.near_ties == [False] * len(envs)
    with torch.no_grad():
        for parameter in network.head.get_submodule(last_layer).parameters():
            parameter.zero_()
    if name == "small":
        network.head.rotation_copy = None  # rotations that the prompt shows would decide
    policy.act([observations[0], None, observations[2]])
    assert policy.near_ties == [True, False, True]


@pytest.mark.parametrize("name", ["nano", "small", "nano-bins", "midas-nano"])
def test_in_single_precision_only_near_ties_depend_on_the_batch(name, starts):
    envs, observations = zip(*starts, strict=True)
    policy = NetworkPolicy(decisive(name), dtype=torch.float32)
    policy.reset([env.prompt for env in envs])
    together, near = policy.act(observations), policy.near_ties
    for row, env in enumerate(envs):
        policy.reset([env.prompt])
        (alone,) = policy.act([observations[row]])
        assert policy.near_ties == [near[row]]
        same = all(np.allclose(alone[key], together[row][key], atol=1e-4) for key in alone)
        assert same or near[row]
