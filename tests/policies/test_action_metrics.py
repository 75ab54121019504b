"""Accuracies of decoded actions, in centimetres and degrees."""

import math

import pytest
import torch

from openvima.policies.nn.actions import ActionTargets, action_metrics, yaw_between


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
