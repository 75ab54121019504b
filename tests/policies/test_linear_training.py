"""The linear layer of training, and its rows."""

import pytest
import torch

from openvima.policies.nn.layers import (
    Linear,
    Unpadder,
    round_rows,
)


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
