"""The published widths with the whole text encoder, against recordings; their weights follow from a recipe.

Every weight is random bytes that its published name seeds, scaled by a power of two. So nothing of 700 MB
needs to be stored, and a wrong name or a transposed matrix shows.
"""

import json
import math
import re
import zlib
from collections.abc import Mapping, Sequence

import numpy as np
import pytest
import torch
from tests.policies.golden import (
    FOLDER,
    Arrays,
    assert_close_to_golden,
    described,
    needs,
    network_of,
    recorded_names,
    recording,
)
from tests.policies.golden_stages import closed_loop, stages

from openvima.policies.build import PolicyConfig, outline_network
from openvima.policies.published import config_from_published
from published_policies import to_published, with_unused_entries

pytestmark = [pytest.mark.slow, needs("fulldims")]

TABLES = re.compile(
    r".*(pos_embed|latents|positions_embed\.weight|prompt_embedding\._embed_layer\.weight|t5\.shared\.weight"
    r"|lm\.tokens_embed\.weight|end_effector_encoder\.weight)"
)
NORM = re.compile(r".*(\bln|norm)\w*\.weight")  # ln_1, ln_pre, ln, layernorm, layer_norm, final_layer_norm
DECODER = re.compile(r".*\.(positions_embed|h|xattns)\..*")
IN_OUT = re.compile(r".*(vit\.projection|(xattn_gpt|lm)\.h\.\d+\.(attn|mlp)\.c_\w+\.weight)")


def models() -> dict[str, dict]:
    return described()["fulldims"]["models"]


@pytest.fixture(scope="module")
def made() -> dict[str, torch.Tensor]:
    """Weights that were made; the models share most of them."""
    return {}


@pytest.fixture(scope="module")
def computed(made: dict[str, torch.Tensor]) -> dict[str, Arrays]:
    """Every stage of every model, computed one model after the other."""
    result = {}
    for model, about in models().items():
        is_vima = model.startswith("vima")
        inputs = recording("vima_tiny" if is_vima else "gato_tiny")
        network = network_of(make_weights(model, about, made), about["cfg"])
        result[model] = stages(network, inputs) | (closed_loop(network, inputs) if is_vima else {})
    return result


@pytest.fixture(scope="module")
def recorded() -> Arrays:
    return recording("fulldims")


@pytest.mark.parametrize("name", recorded_names("fulldims"))
def test_golden_full_width_agrees_in(name: str, computed: dict[str, Arrays], recorded: Arrays):
    model, stage = name.split("/")
    assert_close_to_golden(computed[model][stage], recorded[name])


def test_golden_weights_follow_from_their_names(made: dict[str, torch.Tensor], computed: dict[str, Arrays]):
    """Otherwise the comparison above would be one of other weights."""
    probes = {
        f"{name} {probe['shape']}": probe
        for about in models().values()
        for name, probe in about["weight_probe"].items()
    }
    for key, probe in probes.items():
        assert made[key].flatten()[:4].tolist() == probe["first4"]
        assert made[key].sum(dtype=torch.float64).item() == probe["sum"]


def make_weights(model: str, about: Mapping, made: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Make the weights of a model by their published names, but for those without effect."""
    outline = outline_network(config_of(model, about["cfg"]))
    assert len(with_unused_entries(outline)) == about["n_state_dict_keys"]
    weights = {}
    for name, tensor in to_published(outline).items():
        key = f"{name} {list(tensor.shape)}"
        if key not in made:
            made[key] = make_weight(name, tensor.shape)
        weights[name] = made[key]
    return weights


def config_of(model: str, cfg: Mapping[str, int]) -> PolicyConfig:
    """Sizes of the decoder from `cfg`, all others from the shapes listed for a model of this kind."""
    listed = json.loads((FOLDER / "state_dict_shapes.json").read_text())
    kind = model.split("_")[0]
    tensors = next(
        other["tensors"] for name, other in listed.items() if name.startswith(kind) and "tensors" in other
    )
    shapes = {
        name: torch.empty(shape, device="meta")
        for name, (shape, _) in tensors.items()
        if not DECODER.fullmatch(name)
    }
    return config_from_published(shapes, cfg)


def make_weight(name: str, shape: Sequence[int]) -> torch.Tensor:
    raw = np.random.RandomState(zlib.crc32(name.encode())).bytes(math.prod(shape))
    values = np.frombuffer(raw, np.int8).reshape(shape).astype(np.float32)
    exponent, offset = scale_of(name, shape)
    values *= np.float32(2.0**exponent)
    values += np.float32(offset)
    return torch.from_numpy(values)


def scale_of(name: str, shape: Sequence[int]) -> tuple[int, int]:
    """Exponent of the factor of random bytes, and what is added."""
    if len(shape) == 1:
        if name.endswith("bias"):
            return -10, 0
        return (-9, 1) if NORM.fullmatch(name) else (-7, 0)
    if TABLES.fullmatch(name):
        return -7, 0
    if "relative_attention_bias" in name:
        return -6, 0
    fan_in = shape[0] if IN_OUT.fullmatch(name) else math.prod(shape[1:])
    exponent = -round(math.log2(74 * math.sqrt(fan_in)))
    if name.endswith("SelfAttention.q.weight"):
        exponent -= round(math.log2(math.sqrt(described()["fulldims"]["t5"]["d_kv"])))
    if name.startswith("action_decoder.") and name.endswith(".6.weight"):
        exponent += 2
    return exponent, 0
