"""Continuous action heads: densities, gradients, decoding, and every network with them."""

import math

import numpy as np
import pytest
import torch

from openvima.errors import ConfigError
from openvima.policies import preset
from openvima.policies.build import (
    build_network,
    config_from_dict,
    config_to_dict,
)
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.actions import (
    ActionEncoder,
    ActionTargets,
    greedy,
)
from openvima.policies.nn.heads import (
    MixtureConfig,
    RegressionConfig,
    build_head,
)
from openvima.policies.variants import with_variant
from openvima.scene import Action

WIDTH = 6
CONFIGS = {"mixture": MixtureConfig(8, 4, num_components=3), "regression": RegressionConfig(8, 4)}


def head_of(name: str):
    torch.manual_seed(2)
    head = build_head(CONFIGS[name], WIDTH, ActionEncoder(4, WIDTH)).double()
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    return head


def targets_of(actions: list[Action]) -> ActionTargets:
    """One episode with these actions."""
    rows = [np.concatenate(list(action.to_arrays().values())) for action in actions]
    steps = torch.ones(1, len(rows), dtype=torch.bool)
    none = torch.full((1, len(rows)), -1)
    return ActionTargets(torch.tensor(np.array(rows)).double()[None], none, none, steps)


def constant(numbers: list[float]) -> "torch.nn.Linear":
    """A layer that ignores its input."""
    layer = torch.nn.Linear(WIDTH, len(numbers)).double()
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.copy_(torch.tensor(numbers))
    return layer


ACTIONS = [Action.planar((0.3, -0.2), (0.6, 0.4), 0.7), Action.planar((0.7, 0.1), (0.4, -0.4), -2.9)]


def test_the_density_is_a_mixture_of_normal_and_von_mises_distributions() -> None:
    head, targets = head_of("mixture"), targets_of(ACTIONS)
    query = torch.randn(1, 2, WIDTH, dtype=torch.float64)
    logits, means, yaws, log_stds = head._components(query)
    stds = log_stds.exp()
    positions = torch.tensor([[0.1, 0.3, 0.7, 0.9], [0.9, 0.6, 0.3, 0.1]], dtype=torch.float64)[None, :, None]
    rotations = torch.tensor([0.7, -2.9], dtype=torch.float64)[None, :, None]
    normal = torch.distributions.Normal(means, stds[..., :4]).log_prob(positions).sum(-1)
    angles = torch.atan2(yaws[..., 1], yaws[..., 0])
    circular = torch.distributions.VonMises(angles, stds[..., 4] ** -2).log_prob(rotations)
    expected = torch.logsumexp(torch.log_softmax(logits, -1) + normal + circular, -1)
    torch.testing.assert_close(
        head.log_density(query, targets.actions_BTC), expected, rtol=1e-5, atol=1e-5
    )  # the demonstrations are float32


@pytest.mark.parametrize("name", CONFIGS)
def test_an_action_comes_back_as_it_was_encoded(name) -> None:
    """A head whose output is the demonstrated action returns it."""
    head, targets = head_of(name), targets_of(ACTIONS[:1])
    numbers = [0.1, 0.3, 0.7, 0.9, 0.3 * math.cos(0.7), 0.3 * math.sin(0.7)]
    if name == "mixture":
        other = [*[0.5] * 4, 1.0, 0.0, *[-1.0] * 5]
        numbers = [*other, *numbers, *[-1.0] * 5, *other]
        head.gate = constant([-9.0, 9.0, -9.0])
    head.out = constant(numbers)
    query = torch.zeros(1, 1, WIDTH, dtype=torch.float64)
    torch.testing.assert_close(head.action(query, greedy), targets.actions_BTC, rtol=0, atol=1e-6)
    _, _, actions = head.action_loss(query, targets)
    torch.testing.assert_close(actions, targets.actions_BTC, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", CONFIGS)
def test_the_prior_lowers_the_loss_of_fresh_weights(name) -> None:
    torch.manual_seed(0)
    demonstrated = torch.cat([targets_of(ACTIONS).actions_BTC[0]] * 20)
    head, targets = head_of(name), targets_of(ACTIONS)
    query = torch.zeros(1, 2, WIDTH, dtype=torch.float64)
    fresh, *_ = head.action_loss(query, targets)
    head.fit_prior(demonstrated)
    fitted, *_ = head.action_loss(query, targets)
    assert fitted < fresh - 0.1


def test_sampling_chooses_among_components() -> None:
    head = head_of("mixture")
    query = torch.randn(1, 1, WIDTH, dtype=torch.float64)
    chosen = [
        head.action(query, lambda logits, k=k: torch.full_like(logits[..., 0], k).long()) for k in range(3)
    ]
    assert not torch.equal(chosen[0], chosen[1])
    assert any(torch.equal(head.action(query, greedy), action) for action in chosen)


@pytest.mark.parametrize(
    ("architecture", "head"), [("vima", "mixture"), ("flamingo", "regression"), ("midas", "mixture")]
)
def test_every_network_takes_continuous_heads(architecture, head, starts) -> None:
    config = with_variant(preset(f"{architecture}-nano"), {"head": head})
    assert config_from_dict(config_to_dict(config)) == config
    policy = NetworkPolicy(build_network(config, seed=0))
    policy.reset([env.prompt for env, _ in starts[:2]])
    for _ in range(2):
        for action in policy.act([observation for _, observation in starts[:2]]):
            Action.from_arrays(action)
            assert np.array_equal(action["pose0_rotation"], np.array([0, 0, 0, 1], np.float32))


@pytest.mark.parametrize(
    ("name", "head", "words"),
    [
        ("vima-nano", "gaussian", "gaussian"),
        ("nano", "mixture", "pointer models have pointers to candidates alone"),
    ],
)
def test_what_cannot_be_says_why(name, head, words) -> None:
    with pytest.raises(ConfigError, match=words):
        with_variant(preset(name), {"head": head})
