"""The linear policy and its training."""

import pytest
import torch
from torch.nn import functional as F

from openvima.policies.nn import layers as linear
from openvima.policies.nn.layers import (
    Linear,
    Unpadder,
    round_rows,
)


@pytest.fixture
def layer() -> Linear:
    torch.manual_seed(0)
    return Linear(1024, 512).eval()


def assert_right(layer: Linear, rows: int = 5) -> None:
    """The layer agrees with the plain product in inference mode, but for rounding."""
    x = torch.randn(1, rows, layer.in_features, dtype=layer.weight.dtype)
    expected = F.linear(x, layer.weight, layer.bias).detach()
    with torch.inference_mode():
        torch.testing.assert_close(layer(x), expected, rtol=0, atol=5e-6 * float(expected.abs().max()))


@pytest.mark.parametrize("rows", [1, 2, 15, 128, 129])
@pytest.mark.parametrize("bias", [True, False])
def test_any_number_of_rows_gives_the_product(rows: int, bias: bool) -> None:
    torch.manual_seed(1)
    assert_right(Linear(1024, 512, bias=bias), rows)


def test_weights_changed_in_place_count_at_once(layer) -> None:
    assert_right(layer)
    with torch.no_grad():
        layer.weight.mul_(-2)
    assert_right(layer)
    layer.load_state_dict({name: 3 * tensor for name, tensor in layer.state_dict().items()})
    assert_right(layer)


@pytest.mark.skipif(not linear._HAS_ONEDNN, reason="this torch has no oneDNN")
def test_only_acting_makes_a_packed_copy_and_training_drops_it(layer) -> None:
    layer(torch.randn(5, 1024))
    assert layer._packed is None
    assert_right(layer)
    assert layer._packed is not None
    assert "_packed" not in layer.state_dict()
    layer.train()
    assert layer._packed is None


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("shape", [(300, 24), (90, 5, 24)])
def test_outputs_and_gradients_are_those_of_torch(shape, bias):
    torch.manual_seed(0)
    ours = Linear(24, 17, bias=bias)
    x, gradient = torch.randn(shape), torch.randn(*shape[:-1], 17)
    results = []
    for layer in (ours, torch.nn.functional.linear):
        inputs = x.clone().requires_grad_()
        ours.zero_grad()
        out = ours(inputs) if layer is ours else layer(inputs, ours.weight, ours.bias)
        out.backward(gradient)
        found = [out.detach(), inputs.grad, ours.weight.grad]
        results.append([tensor.clone() for tensor in found + ([ours.bias.grad] if bias else [])])
    for actual, expected in zip(*results, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4)


def test_rows_take_few_numbers_and_grow_little():
    counts = range(1, 20_000)
    rounded = [round_rows(count) for count in counts]
    assert all(0 <= new - old <= old / 16 for old, new in zip(counts, rounded, strict=True))
    assert len({new for new in rounded if new >= 256}) < 130


def test_rounded_rows_change_neither_outputs_nor_gradients():
    torch.manual_seed(0)
    valid = torch.rand(40, 20) < 0.5
    x = torch.randn(40, 20, 8, requires_grad=True)
    unpadder = Unpadder(valid)
    rows = unpadder.unpad(x)
    assert len(rows) == round_rows(int(valid.sum())) > int(valid.sum())
    unpadder.pad(3 * rows).square().sum().backward()
    torch.testing.assert_close(x.grad, 18 * x.detach() * valid[..., None])
    torch.testing.assert_close(unpadder.pad(rows), x.detach() * valid[..., None])
