"""Names, shapes and files of published weights against the recorded ones."""

import json
from dataclasses import replace

import pytest
import torch
from tests.policies.golden import FOLDER, tiny_weights

from openvima.policies import preset
from openvima.policies.build import outline_network
from openvima.policies.nn.decoder import PrefixDecoderConfig
from openvima.policies.published import config_from_published, from_published, load_published
from published_policies import to_published, with_unused_entries

SHAPES = FOLDER / "state_dict_shapes.json"
pytestmark = pytest.mark.skipif(not SHAPES.is_file(), reason=f"no golden data in {FOLDER}")
RECORDED = json.loads(SHAPES.read_text()) if SHAPES.is_file() else {}
TINY = ("vima_tiny", "gato_tiny", "flamingo_tiny", "gpt_tiny")


def recorded_network(name: str):
    """The preset that a recorded entry, such as "vima_2M" or "gato_256_1layer", was made with; no weights."""
    family, size, *_ = name.lower().split("_")
    config = preset(f"{family}-{'2m' if size == '256' else size}")
    if isinstance(config.decoder, PrefixDecoderConfig):
        # One layer there; our presets have as many as VIMA has blocks.
        config = replace(config, decoder=replace(config.decoder, num_layers=RECORDED[name]["cfg"]["n_layer"]))
    return outline_network(config)


@pytest.mark.parametrize("name", RECORDED)
def test_golden_names_shapes_and_dtypes_are_the_published_ones(name) -> None:
    recorded = RECORDED[name]
    weights = with_unused_entries(recorded_network(name))
    assert len(weights) == recorded["n_keys"]
    described = {
        key: [list(tensor.shape), str(tensor.dtype).removeprefix("torch.")] for key, tensor in weights.items()
    }
    assert described == recorded.get("tensors", described)


@pytest.mark.parametrize("name", RECORDED)
def test_golden_numbers_of_parameters_are_the_published_ones(name) -> None:
    """Masks are no parameters, and the unused word embedding counts once though two names have it."""
    recorded = RECORDED[name]
    sizes = {
        key: tensor.numel()
        for key, tensor in with_unused_entries(recorded_network(name)).items()
        if tensor.is_floating_point() and not key.endswith((".attn.bias", ".embed_tokens.weight"))
    }
    blocks = ("xattn_gpt.h.", "xattn_gpt.xattns.", "transformer.lm.h.")
    assert sum(sizes.values()) == recorded["parameters"]
    in_blocks = sum(size for key, size in sizes.items() if key.startswith(blocks))
    assert in_blocks == recorded["decoder_blocks_parameters"]


@pytest.mark.parametrize("name", RECORDED)
def test_golden_cfg_and_shapes_give_the_sizes_back(name) -> None:
    network = recorded_network(name)
    assert config_from_published(to_published(network), RECORDED[name]["cfg"]) == network.config


@pytest.mark.parametrize("name", TINY)
def test_golden_weights_go_to_our_names_and_back(name) -> None:
    weights, cfg = tiny_weights(name)
    network = outline_network(config_from_published(weights, cfg))
    network.load_state_dict(from_published(weights), assign=True)
    back = to_published(network)
    assert all(torch.equal(tensor, weights[key].float()) for key, tensor in back.items())
    whole = with_unused_entries(network)
    dead = {key for key in weights if key not in back}
    assert dead <= whole.keys()
    for key in dead - {"transformer.lm.tokens_embed.weight"}:  # of another size here, and never looked at
        assert whole[key].shape == weights[key].shape


def test_a_golden_file_as_published_loads_with_nothing_missing_and_nothing_left_over() -> None:
    network = load_published(FOLDER / "official_like.ckpt")
    weights, cfg = tiny_weights("vima_tiny")
    assert network.config == config_from_published(weights, cfg)
    expected, loaded = from_published(weights), network.state_dict()
    assert loaded.keys() == expected.keys()
    assert all(torch.equal(loaded[key], expected[key]) for key in expected)


def test_a_golden_file_holds_just_the_names_that_we_would_write() -> None:
    stored = torch.load(FOLDER / "official_like.ckpt", weights_only=True)["state_dict"]
    ours = with_unused_entries(load_published(FOLDER / "official_like.ckpt"))
    assert {f"policy.{key}" for key in ours} == stored.keys()
    for key, tensor in ours.items():
        original = stored[f"policy.{key}"]
        assert (tensor.shape, tensor.dtype) == (original.shape, original.dtype)
        if "t5.shared" not in key and "embed_tokens" not in key:
            assert torch.equal(tensor, original)
