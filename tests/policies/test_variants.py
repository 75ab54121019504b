"""Variants of networks: each switch forward, backward and acting, and what is refused."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from openvima.errors import ConfigError
from openvima.policies import preset
from openvima.policies.build import config_from_dict, config_to_dict, outline_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.image_encoders import Resampler, ResamplerConfig
from openvima.policies.processor import Processor
from openvima.policies.variants import SWITCHES, image_tokens, with_variant
from openvima.training.config import ModelConfig
from small_networks import collate_examples, examples_of, perturbed

VARIANTS = [
    ("vima-nano", {"conditioning": "prefix"}),
    ("vima-nano", {"image_tokens": "object-perceiver"}),
    ("nano-bins", {"image_tokens": "patches"}),
    ("vima-nano", {"width": 96, "num_layers": 1, "tuned_layers": 1}),
    (
        "nano",
        {
            **{"width": 64, "num_layers": 3, "visual_residual": True, "conditioning": "prefix"},
            **{"crop_kernel": 1, "crop_width": 16},
        },
    ),
]
SLOW_VARIANTS = [
    ("midas-nano", {"conditioning": "cross-attention"}),
    ("nano-bins", {"image_tokens": "object-perceiver", "head": "mixture"}),
    ("vima-nano", {"image_tokens": "image-perceiver", "conditioning": "prefix"}),
    ("midas-nano", {"image_tokens": "image", "visual_residual": False}),
    ("gato-nano", {"width": 64, "num_layers": 3, "head": "autoregressive", "tuned_layers": 0}),
]
UNUSED = ("images.appearance.weight", "images.appearance.bias")  # of pretraining


def tiny(name: str, switches: dict):
    """The variant, with a smaller head, which has most of the parameters and is not under test."""
    config = preset(name)
    return with_variant(replace(config, head=replace(config.head, hidden_width=16)), switches)


def act_twice(policy: NetworkPolicy, starts) -> list[np.ndarray]:
    policy.reset([env.prompt for env, _ in starts])
    for _ in range(2):
        actions = policy.act([observation for _, observation in starts])
    return [np.concatenate(list(action.values())) for action in actions]


@pytest.mark.parametrize(
    ("name", "switches"),
    [*VARIANTS, *(pytest.param(*each, marks=pytest.mark.slow) for each in SLOW_VARIANTS)],
)
def test_a_variant_learns_and_acts(name, switches, demonstrations, starts) -> None:
    config = tiny(name, switches)
    assert config != preset(name)
    assert config_from_dict(config_to_dict(config)) == config
    assert with_variant(config, switches) == config

    network = perturbed(config).double()
    processor = Processor(*config.inputs)
    examples, images = examples_of(demonstrations[-2:], processor)
    batch = collate_examples(processor, examples)
    features = network.encode_images(images)
    prompt = network.encode_prompt(batch.prompts, features)
    loss, _ = network.loss(prompt, batch.history, features, batch.targets)
    loss.backward()
    without = [
        key
        for key, p in network.named_parameters()
        if p.requires_grad and (p.grad is None or not p.grad.any())
    ]
    assert [key for key in without if key not in UNUSED] == []

    policy = NetworkPolicy(network)
    together = act_twice(policy, starts[:2])
    assert np.array_equal(together[:1], act_twice(policy, starts[:1]))
    assert not np.array_equal(together[0], together[1])
    if network.explains:
        (explanation,) = policy.explain()
        assert all(sum(weights) == pytest.approx(1) for weights in explanation.attention.values())


def test_training_has_a_setting_for_every_switch() -> None:
    assert set(asdict(ModelConfig())) == set(SWITCHES)
    assert with_variant(preset("nano"), asdict(ModelConfig())) == preset("nano")


def test_conditioning_keeps_the_size_of_the_decoder() -> None:
    """Both directions of the switch are inverse, and the published sizes differ by less than 2 %."""
    config = preset("vima-2m")
    prefix = with_variant(config, {"conditioning": "prefix"})
    assert prefix.decoder == preset("gato-2m").decoder
    assert with_variant(prefix, {"conditioning": "cross-attention"}) == config


def test_image_tokens_are_those_of_the_baselines() -> None:
    for name, switch in {"gato": "patches", "gpt": "image", "flamingo": "image-perceiver"}.items():
        for size in ("nano", "2m"):
            ours = with_variant(preset(f"vima-{size}"), {"image_tokens": switch})
            theirs = preset(f"{name}-{size}")
            assert (ours.images, ours.resampler, ours.inputs) == (
                theirs.images,
                theirs.resampler,
                theirs.inputs,
            )
            assert image_tokens(ours) == image_tokens(theirs) == switch
            assert with_variant(theirs, {"image_tokens": switch}) == theirs
    perceiver = with_variant(preset("vima-nano"), {"image_tokens": "object-perceiver"})
    assert with_variant(perceiver, {"image_tokens": "objects"}) == preset("vima-nano")


def test_text_encoders_have_the_sizes_of_t5() -> None:
    """Parameters of the encoders of T5 1.0 without word embeddings, as transformers counts them."""
    for name, millions in {"t5-small": 18.88, "t5-base": 84.95, "t5-large": 302.04}.items():
        config = with_variant(preset("midas-nano"), {"text_encoder": name})
        assert config.prompt.tokenizer == "t5"
        assert config.prompt.visual_residual
        text = outline_network(config).prompt.text
        assert sum(p.numel() for p in text.parameters()) / 1e6 == pytest.approx(millions, abs=0.01)
        assert [b.query.weight.requires_grad for b in text.blocks][-3:] == [False, True, True]
    assert with_variant(config, {"text_encoder": "small"}).prompt == preset("midas-nano").prompt
    assert with_variant(preset("vima-2m"), {"text_encoder": "t5-base"}) == preset("vima-2m")
    own = with_variant(preset("small"), {"text_encoder": "small"})
    assert own == preset("small")


def resampler_of(num_objects: int):
    torch.manual_seed(5)
    resampler = Resampler(ResamplerConfig(num_layers=1, num_blocks=1), 16).eval()
    with torch.no_grad():
        for parameter in resampler.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    return resampler, torch.randn(3, num_objects, 16)


def test_masked_objects_have_no_influence_on_the_latents() -> None:
    """Neither what they are, nor how many, nor where; to the last bit."""
    resampler, objects = resampler_of(7)
    mask = torch.tensor([[1, 0, 1, 1, 0, 0, 0], [0, 0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0, 0]]).bool()
    latents = resampler(objects, mask)
    assert torch.equal(resampler(objects * mask[..., None] + 99 * ~mask[..., None], mask), latents)
    padded = torch.nn.functional.pad(objects, (0, 0, 2, 40), value=3.0)
    assert torch.equal(resampler(padded, torch.nn.functional.pad(mask, (2, 40))), latents)
    left_out = resampler(objects[:1, [0, 2, 3]], mask[:1, [0, 2, 3]])
    assert torch.equal(left_out, resampler(objects[:1], mask[:1]))
    torch.testing.assert_close(resampler(objects[:1, [0, 2, 3]]), left_out)
    assert not torch.equal(latents[0], latents[1])
    empty = resampler(objects[2:, :0], mask[2:, :0])
    torch.testing.assert_close(empty, latents[2:])


@pytest.mark.parametrize("name", ["vima-nano", "nano-bins"])
def test_the_objects_of_one_prompt_image_do_not_reach_the_tokens_of_another(name, starts) -> None:
    """Blanking the object of the last prompt image changes its latents alone, before the text encoder."""
    config = tiny(name, {"image_tokens": "object-perceiver"})
    network, processor = perturbed(config).double(), Processor(*config.inputs)
    prompts = [env.prompt for env, _ in starts]
    batch, stack = processor.encode_prompts(prompts)
    features = network.encode_images(torch.from_numpy(stack.images()))
    entered = []
    network.prompt.register_forward_pre_hook(lambda _, inputs: entered.append(inputs))
    network.encode_prompt(batch, features)
    network.encode_prompt(
        replace(batch, masks_VS=torch.cat([batch.masks_VS[:, :-1], ~batch.masks_VS[:, -1:]], 1)), features
    )
    before, after = (network.prompt.embed(batch, tokens)[1] for batch, tokens in entered)
    differs = (before != after).any(dim=-1)
    rows = batch.object_index_BL % batch.masks_VS.shape[1]
    of_last = (batch.object_index_BL >= 0) & (rows == rows.max())
    assert torch.equal(differs, of_last)
    assert of_last.sum() == 4


@pytest.mark.parametrize(
    ("name", "switches", "words"),
    [
        ("vima-nano", {"image_tokens": "voxels"}, "image_tokens.*voxels.*object-perceiver"),
        ("gato-nano", {"image_tokens": "objects"}, "has 'patches' alone; take a preset vima-… or midas-…"),
        ("nano", {"image_tokens": "patches"}, "pointer models have objects alone; take nano-bins"),
        ("small", {"text_encoder": "t5-base"}, "pointer models have a vocabulary of words alone"),
        (
            "vima-nano",
            {"tuned_layers": 3},
            "tuned_layers is 3, but the text encoder has 2 layers; give 0 to 2",
        ),
        ("vima-nano", {"width": 130}, "width 130 must be a multiple of its 4 heads"),
        ("vima-nano", {"width": 132, "image_tokens": "object-perceiver"}, "132 must be a multiple of its 8"),
        ("vima-nano", {"width": 10**6}, "width is 1000000; it must be between 0 and 16384"),
        ("nano", {"crop_kernel": 2}, r"no model\..*last_kernel 2\..* Allowed: 1, 3\."),
        ("nano", {"crop_width": 18}, "width is 18; it must be a multiple of 4"),
        ("vima-2m", {"crop_kernel": 1}, "crop_kernel is 1, but the network has no convolutions"),
        ("vima-nano", {"colour": "red"}, "colour"),
    ],
)
def test_what_is_not_allowed_says_why_in_one_line(name, switches, words) -> None:
    with pytest.raises(ConfigError, match=words) as error:
        with_variant(preset(name), switches)
    assert "\n" not in str(error.value)
