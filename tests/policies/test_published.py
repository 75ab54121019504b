"""Published weights: names both ways, sizes from shapes, and files that are read without executing them."""

import pickle
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch

from openvima.errors import InputFileError
from openvima.policies import preset
from openvima.policies.architectures import flamingo, gato, gpt, vima
from openvima.policies.build import (
    PolicyConfig,
    build_network,
    outline_network,
)
from openvima.policies.nn.decoder import DecoderConfig, PrefixDecoderConfig
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig, TextEncoderConfig
from openvima.policies.presets import SIZE_NAMES
from openvima.policies.published import config_from_published, from_published, load_published
from openvima.policies.sizes import Size
from published_policies import Touch, to_published, with_unused_entries

ARCHITECTURES = {"vima": vima, "gato": gato, "flamingo": flamingo, "gpt": gpt}
DECODER_NAMES = {
    "vima": ("xf_n_layers", "sattn_n_heads", "xattn_n_heads"),
    "flamingo": ("dt_n_layers", "dt_n_heads", "xattn_n_heads"),
}


def small(architecture: str) -> PolicyConfig:
    """A published architecture with few and narrow layers; all widths differ."""
    text = TextEncoderConfig(width=40, num_layers=3, num_heads=2, head_width=6, hidden_width=20)
    prompt = PromptEncoderConfig(
        text, 28, vocabulary_size=30, tokenizer="t5", train_words=False, trained_layers=2
    )
    size = Size(32, 2, 4, prompt, image_width=48, image_layers=2, hidden_width=12, action_width=10)
    config = ARCHITECTURES[architecture](size)
    if isinstance(config.decoder, DecoderConfig):
        return replace(config, decoder=replace(config.decoder, num_cross_heads=2))
    return config


def cfg_of(config: PolicyConfig, architecture: str) -> dict[str, int]:
    """What a published file says about a network beside its weights."""
    decoder = config.decoder
    if isinstance(decoder, PrefixDecoderConfig):
        return {"embed_dim": decoder.width, "n_layer": decoder.num_layers, "n_head": decoder.num_heads}
    numbers = (decoder.num_layers, decoder.num_self_heads, decoder.num_cross_heads)
    return {"embed_dim": decoder.width, **dict(zip(DECODER_NAMES[architecture], numbers, strict=True))}


def assert_same(actual: dict, expected: dict) -> None:
    assert actual.keys() == expected.keys()
    different = [name for name in expected if not torch.equal(actual[name], expected[name])]
    assert different == []


@pytest.fixture(params=ARCHITECTURES)
def architecture(request) -> str:
    return request.param


@cache
def drawn(architecture: str) -> PolicyNetwork:
    """A network of random numbers, so that no weight is like another; fresh norms and biases all are."""
    network = build_network(small(architecture), seed=5)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return network


@pytest.fixture
def network(architecture) -> PolicyNetwork:
    return drawn(architecture)


def contents(network: PolicyNetwork, architecture: str, *, unused_entries: bool = True) -> dict:
    weights = with_unused_entries(network) if unused_entries else to_published(network)
    return {
        "state_dict": {f"policy.{name}": tensor for name, tensor in weights.items()},
        "cfg": cfg_of(network.config, architecture),
    }


@pytest.fixture
def vima_contents() -> dict:
    return contents(build_network(small("vima"), seed=0), "vima")


def saved(values: object, folder: Path) -> Path:
    file = folder / "policy.ckpt"
    torch.save(values, file)
    return file


@pytest.mark.parametrize(
    ("architecture", "published", "ours"),
    [
        ("vima", "xattn_gpt.h.1.ln_1.bias", "decoder.self_blocks.1.norm_attention.bias"),
        ("gato", "transformer.lm.h.1.ln_2.bias", "decoder.self_blocks.1.norm_feed_forward.bias"),
        ("vima", "xattn_gpt.xattns.1.layernorm.weight", "decoder.cross_blocks.1.norm_attention.weight"),
        ("vima", "xattn_gpt.xattns.1.ln.weight", "decoder.cross_blocks.1.norm_feed_forward.weight"),
        ("vima", "xattn_gpt.xattns.1.linear1.weight", "decoder.cross_blocks.1.widen.weight"),
        ("flamingo", "xattn_gpt.xattns.0.gated_layer.weight", "decoder.cross_blocks.0.gate.weight"),
        ("vima", "xattn_gpt.xattns.0.attention_out.weight", "decoder.cross_blocks.0.attention_out.weight"),
        ("vima", "obj_encoder.bbox_mlp.top.3.weight", "images.box_encoders.1.2.weight"),
        ("vima", "obj_encoder.pre_transformer_layer.front.bias", "images.fusion.0.bias"),
        (
            "vima",
            "obj_encoder.cropped_img_encoder.vit.blocks.1.ln_2.weight",
            "images.crop_encoder.blocks.1.norm_mlp.weight",
        ),
        ("gpt", "obj_encoder.cropped_img_encoder.vit.ln_pre.bias", "images.norm_before.bias"),
        (
            "flamingo",
            "obj_encoder.peceiver.model.encoder.self_attends.3.attention.self.value.bias",
            "resampler.self_layers.3.value.bias",
        ),
        (
            "flamingo",
            "obj_encoder.peceiver.model.encoder.cross_attention.attention.self.layernorm2.weight",
            "resampler.cross_layer.norm_source.weight",
        ),
        (
            "flamingo",
            "obj_encoder.peceiver.model.encoder.cross_attention.mlp.dense1.weight",
            "resampler.cross_layer.hidden.weight",
        ),
        (
            "vima",
            "t5_prompt_encoder.t5.encoder.block.2.layer.0.SelfAttention.k.weight",
            "prompt.text.blocks.2.key.weight",
        ),
        (
            "vima",
            "t5_prompt_encoder.t5.encoder.block.2.layer.1.layer_norm.weight",
            "prompt.text.blocks.2.norm_feed_forward.weight",
        ),
        ("vima", "prompt_obj_post_layer.6.bias", "prompt.images.4.bias"),
        ("vima", "action_encoder._embed_dict.pose1_position._layer.3.bias", "head.actions.parts.2.2.bias"),
        ("vima", "action_decoder._decoders.pose0_rotation.mlps.3.6.bias", "head.classifiers.5.4.bias"),
        ("vima", "action_decoder._decoders.pose1_position.mlps.1.0.bias", "head.classifiers.7.0.bias"),
    ],
)
def test_weights_of_equal_shapes_are_distinguished(network, architecture, published, ours) -> None:
    weight = to_published(network)[published]
    assert torch.equal(weight, network.state_dict()[ours])


def test_matrices_of_the_decoder_are_published_transposed(network, architecture) -> None:
    prefix = "xattn_gpt" if architecture in DECODER_NAMES else "transformer.lm"
    block, published = network.decoder.self_blocks[1], to_published(network)
    for name, ours in (
        ("attn.c_attn", block.query_key_value),
        ("attn.c_proj", block.attention_out),
        ("mlp.c_fc", block.widen),
        ("mlp.c_proj", block.narrow),
    ):
        assert torch.equal(published[f"{prefix}.h.1.{name}.weight"], ours.weight.T)
    assert torch.equal(published[f"{prefix}.h.1.mlp.gated_layer.weight"], block.gate.weight)
    vit = network.images.crop_encoder if architecture == "vima" else network.images
    name = "obj_encoder.cropped_img_encoder.vit.projection"
    assert torch.equal(published[name], vit.projection.weight.T)


def test_weights_are_published_and_read_in_float32(network) -> None:
    assert {tensor.dtype for tensor in to_published(deepcopy(network).bfloat16()).values()} == {torch.float32}
    halves = {name: tensor.half() for name, tensor in to_published(network).items()}
    assert {tensor.dtype for tensor in from_published(halves).values()} == {torch.float32}


@pytest.mark.parametrize(
    ("architecture", "size"),
    [("vima", size) for size in SIZE_NAMES[1::3]] + [(name, "9m") for name in ARCHITECTURES],
)
def test_sizes_of_every_published_network_follow_from_its_weights(architecture, size) -> None:
    config = preset(f"{architecture}-{size}")
    weights = with_unused_entries(outline_network(config))
    assert config_from_published(weights, cfg_of(config, architecture)) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"embed_dim": 64}, r"do not fit the network of their cfg: .* \(32,\) instead of float32 \(64,\)"),
        ({"xf_n_layers": 3}, r"do not fit the network of their cfg: missing: decoder\.self_blocks\.2"),
        ({"xattn_n_heads": None}, "cfg has xattn_n_heads None; it must hold embed_dim, xf_n_layers, "),
        ({"sattn_n_heads": 4.0, "xattn_n_heads": True}, "cfg has sattn_n_heads 4.0, xattn_n_heads True;"),
        ({"sattn_n_heads": 5}, "width 32 must be a multiple of its 5 heads"),
    ],
)
def test_a_cfg_that_does_not_fit_is_refused(vima_contents, tmp_path, change, message) -> None:
    vima_contents["cfg"] |= change
    file = saved(vima_contents, tmp_path)
    with pytest.raises(InputFileError, match=message) as caught:
        load_published(file)
    assert str(caught.value).startswith(str(file))


@pytest.mark.parametrize("unused_entries", [True, False])
def test_a_file_becomes_the_network_with_or_without_unused_entries(
    network, architecture, tmp_path, unused_entries
) -> None:
    loaded = load_published(saved(contents(network, architecture, unused_entries=unused_entries), tmp_path))
    assert loaded.config == network.config
    assert not loaded.training
    assert_same(loaded.state_dict(), network.state_dict())
    assert_same(dict(loaded.named_buffers()), dict(network.named_buffers()))
    trained = {name: parameter.requires_grad for name, parameter in network.named_parameters()}
    assert {name: parameter.requires_grad for name, parameter in loaded.named_parameters()} == trained


def test_missing_unexpected_and_misshapen_weights_are_listed_in_one_message(vima_contents, tmp_path) -> None:
    weights = vima_contents["state_dict"]
    del weights["policy.end_effector_encoder.weight"], weights["policy.xattn_gpt.positions_embed.weight"]
    weights["policy.surplus.weight"] = torch.zeros(1)
    weights["policy.obs_fusion_layer.bias"] = torch.zeros(3)
    weights["policy.obs_fusion_layer.weight"] = torch.zeros(32, 34, dtype=torch.int64)
    with pytest.raises(InputFileError) as caught:
        load_published(saved(vima_contents, tmp_path))
    message = str(caught.value)
    for part in (
        "missing: ",
        "end_effectors.weight",
        "decoder.positions.weight",
        "unexpected: surplus.weight; ",
        "wrong: ",
        "observation_out.bias is float32 (3,) instead of float32 (32,)",
        "observation_out.weight is int64 (32, 34) instead of float32 (32, 34)",
    ):
        assert part in message


@pytest.mark.parametrize("entry", ["state_dict", "cfg", "more"])
def test_code_in_a_file_is_refused_and_not_executed(vima_contents, tmp_path, entry) -> None:
    trace = tmp_path / "executed"
    file = saved({**vima_contents, entry: Touch(trace)}, tmp_path)
    with pytest.raises(InputFileError, match="Nothing was executed"):
        load_published(file)
    assert not trace.exists()
    torch.load(file, weights_only=False)  # the file would have done it
    assert trace.exists()


def test_a_bare_pickle_is_not_even_read(tmp_path) -> None:
    trace, file = tmp_path / "executed", tmp_path / "policy.ckpt"
    file.write_bytes(pickle.dumps(Touch(trace)))
    with pytest.raises(InputFileError, match="no torch zip archive"):
        load_published(file)
    assert not trace.exists()


@pytest.mark.parametrize("share", [0.01, 0.5, 0.999])
def test_a_file_that_was_cut_is_refused(vima_contents, tmp_path, share) -> None:
    file = saved(vima_contents, tmp_path)
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputFileError, match="ends too early"):
        load_published(file)
