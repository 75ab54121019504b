"""The bins head: encoding, decoding, loss and metrics."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from openvima.policies.nn.action_head import (
    NUM_BINS,
    BinsHead,
    ObservationTokens,
    decode_bins,
    encode_bins,
    spread,
)
from openvima.policies.nn.actions import (
    ACTION_PARTS,
    ActionEncoder,
    ActionTargets,
    greedy,
    to_unit_range,
)
from openvima.scene import Action


def slow_bin(value: float, count: int) -> int:
    """Number of boundaries below the value, of `count` ones from 0 to 1, but no more than the last bin."""
    return min(sum(k / (count - 1) < value for k in range(count)), count - 1)


class Identity:
    """Stands in for a decoder; its outputs are its tokens, and it has no cache."""

    def decode_segments(self, cache, segments):
        return tuple(segment.tokens_BTQD for segment in segments), cache


def observations(query) -> ObservationTokens:
    """One token per step, the action query."""
    exists = torch.ones(query.shape[:2], dtype=torch.bool)
    return ObservationTokens(query[:, :, None], exists[..., None], exists.long() - 1, exists)


def loss_of(network: BinsHead, query, targets: ActionTargets):
    """Loss and metrics given the decoder's outputs at the action queries."""
    return network.loss(Identity(), None, observations(query), targets)[:2]


def head(width: int = 6) -> BinsHead:
    torch.manual_seed(0)
    return BinsHead(8, width, ActionEncoder(256, width))


def test_x_has_50_bins_y_100_and_every_quaternion_component_50():
    assert NUM_BINS == (50, 100, 50, 50, 50, 50) * 2


@settings(max_examples=100, derandomize=True)
@given(st.floats(-0.5, 1.5, width=32))
def test_a_value_falls_into_the_bin_of_the_definition(value):
    for count in (50, 100):  # whole float32 steps away from any boundary, where rounding would decide
        if min(abs(value * (count - 1) - k) for k in range(count)) < 1e-4:
            return
    bins = encode_bins(torch.full((12,), value))
    assert bins.tolist() == [slow_bin(value, count) for count in NUM_BINS]


@pytest.mark.parametrize("value", [-3.0, 0.0, 1e-7, 0.5, 1.0, 1.5])
def test_values_at_and_beyond_the_ends_go_to_the_end_bins(value):
    bins = encode_bins(torch.full((2, 3, 12), value))
    assert bins.shape == (2, 3, 12)
    assert (bins == torch.tensor([slow_bin(value, count) for count in NUM_BINS])).all()


def test_bin_k_of_n_decodes_to_k_over_n():
    last = decode_bins(torch.tensor([count - 1 for count in NUM_BINS]), torch.float64)
    assert last.tolist() == [0.98, 0.99, 0.98, 0.98, 0.98, 0.98] * 2
    assert decode_bins(torch.zeros(12, dtype=torch.int64)).tolist() == [0.0] * 12


def test_greedy_decoding_takes_the_highest_logit_and_stays_within_bounds():
    network = head()
    query = 50 * torch.randn(3, 4, 6, generator=torch.Generator().manual_seed(1))
    decided = network.action(query, greedy).detach()
    assert decided.shape == (3, 4, 12)
    for component, scores in enumerate(network.logits(query)):
        value = to_unit_range(decided)[..., component] * NUM_BINS[component]
        torch.testing.assert_close(value, scores.argmax(-1).float(), atol=1e-4, rtol=0)
    for vector in decided.flatten(0, 1).numpy():
        Action.from_arrays({key: vector[part] for key, part in ACTION_PARTS.items()})


def test_steps_that_do_not_exist_have_no_loss():
    network = head()
    generator = torch.Generator().manual_seed(2)
    query, actions = torch.randn(1, 3, 6, generator=generator), torch.rand(1, 3, 12, generator=generator)
    slots = torch.zeros(1, 3, dtype=torch.int64)
    targets = ActionTargets(actions, slots, slots, torch.tensor([[True, True, False]]))
    loss, metrics = loss_of(network, query, targets)
    query[0, 2], actions[0, 2] = 7.0, 0.7
    changed, changed_metrics = loss_of(network, query, replace(targets, actions_BTC=actions))
    assert changed == loss
    assert changed_metrics == metrics


def test_a_position_counts_as_much_as_a_rotation_of_twice_its_length():
    network = head()
    query = torch.randn(1, 2, 6, generator=torch.Generator().manual_seed(3))
    actions = torch.tensor([0.6, 0.1, 0.0, 0.0, 0.6, 0.8, 0.4, -0.2, 0.0, 0.0, -0.6, 0.8]).expand(1, 2, 12)
    exists, slots = torch.ones(1, 2, dtype=torch.bool), torch.zeros(1, 2, dtype=torch.int64)
    loss, metrics = loss_of(network, query, ActionTargets(actions, slots, slots, exists))
    bins = encode_bins(to_unit_range(actions))
    nlls = []
    for component, scores in enumerate(network.logits(query)):
        log_probs = scores.detach().log_softmax(-1)
        nlls.append(-sum(log_probs[0, t, bins[0, t, component]].item() for t in range(2)) / 2)
    expected = sum(sum(nlls[part]) / len(nlls[part]) for part in ACTION_PARTS.values())
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    assert sum(metrics[f"loss/{name}"] for name in ACTION_PARTS).item() == pytest.approx(expected, rel=1e-5)


def test_the_prior_is_the_frequency_of_the_bins():
    network = head()
    actions = torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0, 1.0] * 2).repeat(4, 1)
    actions[3, 0] = 0.7
    network.fit_prior(actions)
    with torch.no_grad():
        network.classifiers[0][-1].weight.zero_()
        probabilities = network.logits(torch.ones(1, 1, 6))[0][0, 0].softmax(-1)
    bins = encode_bins(to_unit_range(actions))[:, 0]
    assert probabilities[bins[0]].item() == pytest.approx(0.99 * 0.75 + 0.01 / 50)
    assert probabilities[bins[3]].item() == pytest.approx(0.99 * 0.25 + 0.01 / 50)
    assert probabilities.min().item() == pytest.approx(0.01 / 50)


def test_equal_queries_have_no_spread_and_opposite_ones_the_whole():
    exists = torch.tensor([[True, True, False]])
    query = torch.tensor([[[1.0, -2.0], [1.0, -2.0], [9.0, 9.0]]])
    assert spread(query, exists) == 0
    query[0, 1] *= -1
    assert spread(query, exists) == 1
