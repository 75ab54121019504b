"""The loss of real demonstrations moves every parameter that it is meant to move, and no other."""

import pytest
import torch

from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.policies import preset
from openvima.policies.architectures import flamingo, gato, gpt, midas, vima
from openvima.policies.batch import PromptBatch
from openvima.policies.build import PolicyConfig, build_network
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.nn.prompt_encoder import (
    PromptEncoder,
    PromptEncoderConfig,
    TextEncoderConfig,
)
from openvima.policies.processor import Processor
from openvima.policies.sizes import VOCABULARY_SIZE, Size
from small_networks import (
    collate_examples,
    examples_of,
    narrow_small,
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
    None: {"prompt.words.weight"},
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


def prompt_sizes(trained_layers: int | None, *, train_words: bool = False) -> PromptEncoderConfig:
    text = TextEncoderConfig(width=48, num_layers=NUM_LAYERS, num_heads=2, head_width=8, hidden_width=64)
    return PromptEncoderConfig(
        text, 48, VOCABULARY_SIZE, train_words=train_words, trained_layers=trained_layers
    )


def published_layout(architecture: str, prompt: PromptEncoderConfig) -> PolicyConfig:
    """A policy laid out as the published ones, in small."""
    sizes = {"image_width": 48, "image_layers": 2, "image_heads": 4, "hidden_width": 32, "action_width": 16}
    return PUBLISHED[architecture](Size(width=64, num_layers=2, num_heads=2, prompt=prompt, **sizes))


def reached(sizes: PolicyConfig, demonstrations) -> tuple[PolicyNetwork, set[str]]:
    """A network after a backward pass, and the names of the parameters that have a gradient."""
    model = build_network(sizes, seed=0).eval()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():  # layers that start at zero stop gradients on their first step
        for parameter in model.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    processor = Processor.of(sizes.inputs)
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


def test_the_pointing_loss_reaches_every_parameter(demonstrations, small_sizes) -> None:
    model, moved = reached(small_sizes, demonstrations)
    assert names(model) - moved == set()


def test_the_candidate_loss_reaches_every_parameter(long_and_short) -> None:
    """With prompts that show changes: other ones leave nothing to compare."""
    model, moved = reached(narrow_small(), long_and_short)
    assert names(model) - moved == set()


def test_the_bins_loss_reaches_every_parameter_but_the_appearance_that_pointing_needs(
    demonstrations, small_bins_sizes
) -> None:
    model, moved = reached(small_bins_sizes, demonstrations)
    assert names(model) - moved == {"images.appearance.weight", "images.appearance.bias"}


@pytest.mark.parametrize("architecture", PUBLISHED)
@pytest.mark.slow
def test_the_loss_reaches_every_parameter_of_the_nano_presets(architecture, demonstrations) -> None:
    model, moved = reached(preset(f"{architecture}-nano"), demonstrations)
    assert names(model) - moved == set()


@pytest.mark.parametrize("architecture", PUBLISHED)
@pytest.mark.parametrize("trained_layers", FROZEN)
def test_the_loss_reaches_every_parameter_that_is_not_frozen_and_no_frozen_one(
    architecture, trained_layers, demonstrations
) -> None:
    model, moved = reached(published_layout(architecture, prompt_sizes(trained_layers)), demonstrations)
    assert names(model) - moved == FROZEN[trained_layers]
    assert {name for name, p in model.named_parameters() if p.grad is None} == FROZEN[trained_layers]
    assert {name for name, p in model.named_parameters() if not p.requires_grad} == FROZEN[trained_layers]


@pytest.mark.parametrize("architecture", PUBLISHED)
def test_the_published_presets_freeze_the_words_and_all_but_two_layers_of_t5(architecture) -> None:
    prompt = preset(f"{architecture}-2m").prompt
    assert (prompt.train_words, prompt.trained_layers, prompt.text.num_layers) == (False, 2, 12)


def prompt_encoder(trained_layers: int | None) -> PromptEncoder:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return PromptEncoder(prompt_sizes(trained_layers), image_token_width=16, width=64)


def encoded(encoder: PromptEncoder, images_IE):
    word_ids_BL = torch.arange(20).view(2, 10)
    object_index_BL = torch.full_like(word_ids_BL, -1)
    object_index_BL[:, 3 : 3 + len(images_IE) // 2] = torch.arange(len(images_IE)).view(2, -1)
    mask_BL, no_objects = torch.ones_like(word_ids_BL, dtype=torch.bool), torch.zeros(0)
    return encoder(PromptBatch(word_ids_BL, object_index_BL, mask_BL, ~mask_BL, *[no_objects] * 6), images_IE)


def test_gradients_reach_images_through_a_frozen_text_encoder() -> None:
    images_IE = torch.randn(4, 16, generator=torch.Generator().manual_seed(0)).requires_grad_()
    encoded(prompt_encoder(0), images_IE).square().sum().backward()
    assert images_IE.grad is not None
    assert images_IE.grad.any(dim=1).all()
