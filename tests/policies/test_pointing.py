"""The loss on which object is picked and at which one it is placed."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from openvima.errors import ConfigError
from openvima.policies.nn.action_head import ObservationTokens, add_pointing, pointing_loss
from openvima.policies.nn.actions import PLACE_NEAR_M, ActionTargets
from openvima.policies.presets import preset
from openvima.training import TrainingConfig
from openvima.training.building import build_learner, resolve

B, T, Q, D = 2, 3, 5, 8


def _inputs(
    generator: torch.Generator,
) -> tuple[torch.Tensor, torch.Tensor, ObservationTokens, ActionTargets]:
    (
        pick,
        place,
    ) = torch.randn(2, B, T, D, generator=generator)
    points = torch.rand(B, T, Q, 2, generator=generator, dtype=torch.float64)
    points[:, :, 0] = math.inf  # no object in the top view
    points[1, 1] = math.inf  # nor any in this step
    steps = torch.tensor([[True, True, True], [True, True, False]])
    tokens = torch.randn(B, T, Q, D, generator=generator, requires_grad=True)
    observations = ObservationTokens(
        tokens, points[..., 0].isfinite(), torch.zeros(B, T, dtype=torch.int64), steps, points
    )
    actions = torch.rand(B, T, 12, generator=generator)
    actions[:, 0, 6:8] = points[:, 0, 2].float() + PLACE_NEAR_M / 2  # near an object; the others may not be
    none = torch.full((B, T), -1)
    return pick, place, observations, ActionTargets(actions, none, none, steps)


def test_it_is_the_cross_entropy_of_the_object_nearest_to_the_demonstrated_position():
    pick, place, observations, targets = _inputs(torch.Generator().manual_seed(0))
    loss = pointing_loss(pick, place, observations, targets)
    found = (torch.zeros(()), {}, targets.actions_BTC)
    value = add_pointing(found, 1.0, pick, place, observations, targets)[1]["loss/pointing"]
    total, counted = 0.0, 0
    tokens, points = observations.tokens_BTQD.detach().numpy(), observations.points_BTQ2.numpy()
    for b, t in np.argwhere(targets.steps_BT.numpy()):
        for query, half, part, limit in (
            (pick, slice(0, 4), slice(0, 2), math.inf),
            (place, slice(4, 8), slice(6, 8), PLACE_NEAR_M),
        ):
            exist = np.flatnonzero(np.isfinite(points[b, t, :, 0]))
            distances = np.linalg.norm(points[b, t] - targets.actions_BTC[b, t, part].numpy(), axis=-1)
            if not len(exist) or distances[exist].min() >= limit:
                continue
            scores = tokens[b, t, :, half] @ query[b, t, half].numpy() / 2
            total += np.log(np.exp(scores[exist]).sum()) - scores[distances.argmin()]
            counted += 1
    assert 5 < counted < 10
    assert loss.item() == pytest.approx(total / targets.steps_BT.sum().item(), rel=1e-5)
    assert value.item() == loss.item() and not value.requires_grad
    loss.backward()
    assert observations.tokens_BTQD.grad[targets.steps_BT].isfinite().all()


@pytest.mark.parametrize("name", ["small", "gato-nano", "flamingo-nano"])
def test_policies_without_a_token_for_each_object_refuse_it(name):
    config = TrainingConfig.of(
        {"data": Path("demos"), "out": Path("run"), "preset": name, "optimizer.pointing_loss_weight": 0.5}
    )
    with pytest.raises(ConfigError, match=f"pointing_loss_weight is 0.5, but preset '{name}'"):
        resolve(config)


@pytest.mark.parametrize("name", ["vima-nano", "midas-nano", "nano-bins"])
def test_it_adds_no_weights(name):
    config = TrainingConfig.of(
        {"data": Path("demos"), "out": Path("run"), "preset": name, "optimizer.pointing_loss_weight": 0.5}
    )
    network = build_learner(config, ["put the block"]).network
    assert network.head.pointing_weight == 0.5
    assert network.config.head == preset(name).head
