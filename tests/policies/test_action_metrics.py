"""Metrics of actions, and near ties."""

import math

import numpy as np
import pytest
import torch

from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.actions import ActionTargets, action_metrics, yaw_between
from openvima.policies.nn.policy_network import PolicyNetwork
from small_networks import perturbed


def action(*, pick=(0.5, 0.0), place=(0.6, 0.2), yaw_deg=0.0) -> list[float]:
    half = math.radians(yaw_deg) / 2
    return [*pick, 0.0, 0.0, 0.0, 1.0, *place, 0.0, 0.0, math.sin(half), math.cos(half)]


def metrics_of(done, wanted, points=(), exist=None):
    steps = torch.ones(1, len(wanted), dtype=torch.bool) if exist is None else torch.tensor([exist])
    slots = torch.zeros(1, len(wanted), dtype=torch.int64)
    targets = ActionTargets(torch.tensor([wanted]), slots, slots, steps)
    points_BTN2 = torch.tensor([[list(points)] * len(wanted)]).reshape(1, len(wanted), -1, 2)
    in_view = torch.ones(points_BTN2.shape[:3], dtype=torch.bool)
    found = action_metrics(torch.tensor([done]), targets, points_BTN2, in_view)
    return {name: value.item() for name, value in found.items()}


def test_the_yaw_is_that_from_pick_to_place():
    turned = torch.tensor(action(yaw_deg=70.0))
    assert math.degrees(yaw_between(turned).item()) == pytest.approx(70, abs=1e-3)
    # A quaternion and its negative are one rotation.
    turned[8:] *= -1
    assert math.cos(yaw_between(turned).item()) == pytest.approx(math.cos(math.radians(70)), abs=1e-5)


def test_accuracies_are_fractions_of_the_steps_within_2_cm_4_cm_and_15_degrees():
    wanted = [action(), action(), action(), action()]
    done = [
        action(pick=(0.519, 0.0), place=(0.6, 0.239), yaw_deg=-14.0),
        action(pick=(0.521, 0.0)),
        action(place=(0.6, 0.241)),
        action(yaw_deg=16.0),
    ]
    assert metrics_of(done, wanted) == pytest.approx(
        {"accuracy": 0.25, "pick_accuracy": 0.75, "place_accuracy": 0.75, "rotation_accuracy": 0.75}
    )


def test_a_pick_is_of_the_nearest_object():
    wanted, done = [action(), action()], [action(pick=(0.47, 0.0)), action(pick=(0.42, 0.0))]
    found = metrics_of(done, wanted, points=[(0.5, 0.0), (0.4, 0.0)])
    assert (found["object_accuracy"], found["pick_accuracy"]) == (0.5, 0.0)


def test_steps_that_do_not_exist_do_not_count():
    wanted, done = [action(), action()], [action(), action(pick=(0.3, 0.0))]
    assert metrics_of(done, wanted, exist=[True, False])["accuracy"] == 1


def decisive(name: str) -> PolicyNetwork:
    """A network whose classes score far apart; fresh heads score them all alike."""
    return perturbed(name, 0.1, seed=5)


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
