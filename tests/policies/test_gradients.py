"""With either head, the loss of real demonstrations moves every parameter that it is meant to move."""

from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")

from openvima.policies.heads.bins import BinsConfig  # noqa: E402
from openvima.policies.inputs import Reader  # noqa: E402
from openvima.policies.network import PolicyNetwork, build_network  # noqa: E402
from openvima.training.dataset import make_batch, read_examples  # noqa: E402


def without_gradient(model: PolicyNetwork, demonstrations) -> set[str]:
    """Names of the parameters that the loss of the demonstrations leaves alone; none has a bad gradient."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():  # layers that start at zero stop gradients on their first step
        for parameter in model.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    examples = read_examples(demonstrations, Reader.of(model.config.images), validation_share=0, seed=0)
    batch = make_batch(examples.training)
    features = model.encode_images(examples.images)
    memory = model.encode_prompts(batch.prompts, features)
    inputs = model(memory, batch.history, features, batch.targets.actions_BTC)
    model.head.loss(inputs, batch.targets)[0].backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    return {name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()}


def test_the_pointing_loss_reaches_every_parameter(demonstrations, small_sizes) -> None:
    assert without_gradient(build_network(small_sizes, seed=0).eval(), demonstrations) == set()


def test_the_bins_loss_reaches_every_parameter_but_the_appearance_that_pointing_needs(
    demonstrations, small_sizes
) -> None:
    sizes = replace(small_sizes, head=BinsConfig(hidden_width=32))
    untouched = without_gradient(build_network(sizes, seed=0).eval(), demonstrations)
    assert untouched == {"images.appearance.weight", "images.appearance.bias"}


def test_separate_views_without_appearance_are_reached_too(demonstrations, small_sizes) -> None:
    objects = replace(small_sizes.images, fuse_views=False, appearance_width=0)
    sizes = replace(small_sizes, images=objects, head=BinsConfig(32), query_token=False)
    model = build_network(sizes, seed=0).eval()
    examples = read_examples(demonstrations, Reader.of(sizes.images), validation_share=0, seed=0)
    batch = make_batch(examples.training)
    features = model.encode_images(examples.images)
    memory = model.encode_prompts(batch.prompts, features)
    inputs = model(memory, batch.history, features, batch.targets.actions_BTC)
    model.head.loss(inputs, batch.targets)[0].backward()
    assert {name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()} == set()
