"""The loss of real demonstrations moves every parameter that it is meant to move, and no other."""

import pytest

from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.policies.architectures import flamingo, gato, gpt, midas, vima
from openvima.policies.build import PolicyConfig
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.nn.prompt_encoder import (
    PromptEncoderConfig,
    TextEncoderConfig,
)
from openvima.policies.processor import Processor
from openvima.policies.sizes import VOCABULARY_SIZE, Size
from small_networks import (
    collate_examples,
    examples_of,
    narrow_small,
    perturbed,
)

PUBLISHED = {"vima": vima, "gato": gato, "flamingo": flamingo, "gpt": gpt, "midas": midas}
NUM_LAYERS = 3  # of the text encoder
IN_A_BLOCK = (
    "norm_attention",
    "query",
    "key",
    "value",
    "attention_out",
    "norm_feed_forward",
    "widen",
    "narrow",
)
# Parameters that do not learn, by the number of layers of the text encoder that do.
FROZEN = {
    None: set(),
    2: {
        "prompt.words.weight",
        "prompt.text.position_bias.weight",
        *(f"prompt.text.blocks.0.{name}.weight" for name in IN_A_BLOCK),
    },
    0: {
        "prompt.words.weight",
        "prompt.text.position_bias.weight",
        *(f"prompt.text.blocks.{layer}.{name}.weight" for layer in range(NUM_LAYERS) for name in IN_A_BLOCK),
        "prompt.text.norm_after.weight",
    },
}


def prompt_sizes(trained_layers: int | None) -> PromptEncoderConfig:
    """Words are trained where all layers are."""
    text = TextEncoderConfig(width=48, num_layers=NUM_LAYERS, num_heads=2, head_width=8, hidden_width=64)
    train_words = trained_layers is None
    return PromptEncoderConfig(
        text, 48, VOCABULARY_SIZE, train_words=train_words, trained_layers=trained_layers
    )


def published_layout(architecture: str, prompt: PromptEncoderConfig) -> PolicyConfig:
    """A policy laid out as the published ones, in small."""
    sizes = {"image_width": 48, "image_layers": 2, "image_heads": 4, "hidden_width": 32, "action_width": 16}
    return PUBLISHED[architecture](Size(width=64, num_layers=2, num_heads=2, prompt=prompt, **sizes))


def reached(sizes: PolicyConfig, demonstrations) -> tuple[PolicyNetwork, set[str]]:
    """A network after a backward pass, and the names of the parameters that have a gradient."""
    model = perturbed(sizes, 0.02, seed=0)  # layers that start at zero stop gradients on their first step
    processor = Processor(*sizes.inputs)
    examples, images = examples_of(demonstrations, processor)
    batch = collate_examples(processor, examples)
    features = model.encode_images(images)
    prompt = model.encode_prompt(batch.prompts, features)
    model.loss(prompt, batch.history, features, batch.targets)[0].backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    return model, {name for name, p in model.named_parameters() if p.grad is not None and p.grad.any()}


@pytest.fixture(scope="module")
def long_and_short(demonstrations) -> list[Demonstration]:
    """Of one step and of several; prompts show changes, and something has to be cleared away."""
    changes = [
        rollout_oracle(TabletopEnv(task, level="train", domain="user"), 1)
        for task in ("twist", "follow_order", "rearrange_then_restore")
    ]
    return [*demonstrations[:3], *changes]


def names(model: PolicyNetwork) -> set[str]:
    return {name for name, _ in model.named_parameters()}


def test_the_loss_of_a_pointer_reaches_every_parameter(demonstrations, long_and_short, small_sizes) -> None:
    """That of candidates with prompts that show changes: other ones leave nothing to compare."""
    for sizes, given in ((small_sizes, demonstrations), (narrow_small(), long_and_short)):
        model, moved = reached(sizes, given)
        assert names(model) - moved == set()


def test_the_bins_loss_reaches_every_parameter_but_the_appearance_that_pointing_needs(
    demonstrations, small_bins_sizes
) -> None:
    model, moved = reached(small_bins_sizes, demonstrations)
    assert names(model) - moved == {"images.appearance.weight", "images.appearance.bias"}


@pytest.mark.parametrize(
    ("architecture", "trained_layers"),
    [*((architecture, None) for architecture in PUBLISHED), ("vima", 2), ("vima", 0), ("gpt", 0)],
)
def test_the_loss_reaches_every_parameter_that_is_not_frozen_and_no_frozen_one(
    architecture, trained_layers, demonstrations
) -> None:
    model, moved = reached(published_layout(architecture, prompt_sizes(trained_layers)), demonstrations)
    assert names(model) - moved == FROZEN[trained_layers]
    assert {name for name, p in model.named_parameters() if p.grad is None} == FROZEN[trained_layers]
    assert {name for name, p in model.named_parameters() if not p.requires_grad} == FROZEN[trained_layers]
