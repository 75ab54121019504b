"""Names of weights in published files and in this package, as rules that the architectures combine.

`*` stands for a number; a name stands for itself and for its `.weight` and `.bias`. Each architecture has an
adapter in its `published.py`.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch

from openvima.errors import CheckpointError
from openvima.policies.architectures import flamingo, gato, gpt, vima
from openvima.policies.nn.actions import ACTION_PARTS
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.sizes import Size


@dataclass(frozen=True, slots=True)
class Rule:
    """One line of the table.

    Args:
        published: Name in a published file.
        ours: Name in this package.
        transposed: Whether the file holds the matrix as (in, out).
    """

    published: str
    ours: str
    transposed: bool = False


def stack_rules(published: str, ours: str, num_layers: int) -> tuple[Rule, ...]:
    """An MLP: two layers without weights between linear ones there, one here."""
    return tuple(Rule(f"{published}.{3 * i}", f"{ours}.{2 * i}") for i in range(num_layers))


def vit_rules(ours: str) -> tuple[Rule, ...]:
    """Rules of the vision transformer."""
    published = "obj_encoder.cropped_img_encoder.vit"
    return (
        Rule(f"{published}.cls_token", f"{ours}.class_token"),
        Rule(f"{published}.pos_embed", f"{ours}.positions"),
        Rule(f"{published}.projection", f"{ours}.projection.weight", transposed=True),
        Rule(f"{published}.conv1", f"{ours}.patches"),
        Rule(f"{published}.ln_pre", f"{ours}.norm_before"),
        Rule(f"{published}.ln_post", f"{ours}.norm_after"),
        Rule(f"{published}.blocks.*.attn.in_proj_weight", f"{ours}.blocks.*.query_key_value.weight"),
        Rule(f"{published}.blocks.*.attn.in_proj_bias", f"{ours}.blocks.*.query_key_value.bias"),
        Rule(f"{published}.blocks.*.attn.out_proj", f"{ours}.blocks.*.attention_out"),
        Rule(f"{published}.blocks.*.ln_1", f"{ours}.blocks.*.norm_attention"),
        Rule(f"{published}.blocks.*.ln_2", f"{ours}.blocks.*.norm_mlp"),
        Rule(f"{published}.blocks.*.mlp.c_fc", f"{ours}.blocks.*.widen"),
        Rule(f"{published}.blocks.*.mlp.c_proj", f"{ours}.blocks.*.narrow"),
    )


def _self_blocks(published: str) -> tuple[Rule, ...]:
    return (
        Rule(f"{published}.positions_embed", "decoder.positions"),
        Rule(f"{published}.h.*.attn.c_attn", "decoder.self_blocks.*.query_key_value", transposed=True),
        Rule(f"{published}.h.*.attn.c_proj", "decoder.self_blocks.*.attention_out", transposed=True),
        Rule(f"{published}.h.*.ln_1", "decoder.self_blocks.*.norm_attention"),
        Rule(f"{published}.h.*.mlp.c_fc", "decoder.self_blocks.*.widen", transposed=True),
        Rule(f"{published}.h.*.mlp.c_proj", "decoder.self_blocks.*.narrow", transposed=True),
        Rule(f"{published}.h.*.mlp.gated_layer", "decoder.self_blocks.*.gate"),
        Rule(f"{published}.h.*.ln_2", "decoder.self_blocks.*.norm_feed_forward"),
    )


T5 = "t5_prompt_encoder.t5.encoder"
PROMPT_RULES = (
    Rule("prompt_embedding._embed_layer", "prompt.words"),
    Rule(f"{T5}.block.0.layer.0.SelfAttention.relative_attention_bias", "prompt.text.position_bias"),
    Rule(f"{T5}.block.*.layer.0.layer_norm", "prompt.text.blocks.*.norm_attention"),
    Rule(f"{T5}.block.*.layer.0.SelfAttention.q", "prompt.text.blocks.*.query"),
    Rule(f"{T5}.block.*.layer.0.SelfAttention.k", "prompt.text.blocks.*.key"),
    Rule(f"{T5}.block.*.layer.0.SelfAttention.v", "prompt.text.blocks.*.value"),
    Rule(f"{T5}.block.*.layer.0.SelfAttention.o", "prompt.text.blocks.*.attention_out"),
    Rule(f"{T5}.block.*.layer.1.layer_norm", "prompt.text.blocks.*.norm_feed_forward"),
    Rule(f"{T5}.block.*.layer.1.DenseReluDense.wi", "prompt.text.blocks.*.widen"),
    Rule(f"{T5}.block.*.layer.1.DenseReluDense.wo", "prompt.text.blocks.*.narrow"),
    Rule(f"{T5}.final_layer_norm", "prompt.text.norm_after"),
    Rule("t5_prompt_encoder_post_layer", "prompt.out"),
    *stack_rules("prompt_obj_post_layer", "prompt.images", 3),
)
_ACTIONS = (
    *(
        rule
        for part, name in enumerate(ACTION_PARTS)
        for rule in stack_rules(f"action_encoder._embed_dict.{name}._layer", f"head.actions.parts.{part}", 2)
    ),
    Rule("action_encoder._post_layer", "head.actions.out"),
    *(
        rule
        for name, components in ACTION_PARTS.items()
        for i, component in enumerate(range(components.start, components.stop))
        for rule in stack_rules(
            f"action_decoder._decoders.{name}.mlps.{i}", f"head.classifiers.{component}", 3
        )
    ),
)
SHARED_RULES = (
    *PROMPT_RULES,
    *_ACTIONS,
    Rule("end_effector_encoder", "end_effectors"),
    Rule("obs_fusion_layer", "observation_out"),
)
CROSS_ATTENTION_RULES = (
    *_self_blocks("xattn_gpt"),
    Rule("xattn_gpt.xattn_positions_embed", "decoder.prompt_positions"),
    Rule("xattn_gpt.xattns.*.layernorm", "decoder.cross_blocks.*.norm_attention"),
    Rule("xattn_gpt.xattns.*.query", "decoder.cross_blocks.*.query"),
    Rule("xattn_gpt.xattns.*.key_value", "decoder.cross_blocks.*.key_value"),
    Rule("xattn_gpt.xattns.*.attention_out", "decoder.cross_blocks.*.attention_out"),
    Rule("xattn_gpt.xattns.*.ln", "decoder.cross_blocks.*.norm_feed_forward"),
    Rule("xattn_gpt.xattns.*.linear1", "decoder.cross_blocks.*.widen"),
    Rule("xattn_gpt.xattns.*.linear2", "decoder.cross_blocks.*.narrow"),
    Rule("xattn_gpt.xattns.*.gated_layer", "decoder.cross_blocks.*.gate"),
)
PREFIX_RULES = (
    *_self_blocks("transformer.lm"),
    Rule("prompt_sep_token", "decoder.separator"),
)


@dataclass(frozen=True, slots=True)
class PublishedAdapter:
    """How to load published files of one architecture.

    Args:
        architecture: Its name.
        rules: Names of all weights.
        cfg_names: What `cfg` calls the width, the number of layers and the numbers of heads.
        decoder: Prefix of the decoder's weights.
        build: Its config in a size.
    """

    architecture: str
    rules: tuple[Rule, ...]
    cfg_names: tuple[str, ...]
    decoder: str
    build: Callable[[Size], Any]  # Any: the config of the architecture


def to_ours(rules: Iterable[Rule], name: str) -> tuple[str, bool] | None:
    """Return our name of a published weight and whether to transpose it; None if there is no such weight."""
    return _renamed(name, [(rule.published, rule.ours, rule.transposed) for rule in rules])


def to_theirs(rules: Iterable[Rule], name: str) -> tuple[str, bool] | None:
    """Return the published name of one of our weights and whether to transpose it; None if it has none."""
    return _renamed(name, [(rule.ours, rule.published, rule.transposed) for rule in rules])


def _renamed(name: str, rows: list[tuple[str, str, bool]]) -> tuple[str, bool] | None:
    for before, after, transposed in rows:
        match = _pattern(before).fullmatch(name)
        if match:
            *numbers, ending = match.groups(default="")
            for number in numbers:
                after = after.replace("*", number, 1)
            return after + ending, transposed
    return None


@cache
def _pattern(template: str) -> re.Pattern[str]:
    return re.compile(re.escape(template).replace(r"\*", r"(\d+)") + r"(\.weight|\.bias)?")


_OBJECT_RULES = (
    *stack_rules("obj_encoder.bbox_mlp.front", "images.box_encoders.0", 3),
    *stack_rules("obj_encoder.bbox_mlp.top", "images.box_encoders.1", 3),
    Rule("obj_encoder.pre_transformer_layer.front", "images.fusion.0"),
    Rule("obj_encoder.pre_transformer_layer.top", "images.fusion.1"),
)
VIMA = PublishedAdapter(
    "vima",
    (*SHARED_RULES, *vit_rules("images.crop_encoder"), *_OBJECT_RULES, *CROSS_ATTENTION_RULES),
    cfg_names=("embed_dim", "xf_n_layers", "sattn_n_heads", "xattn_n_heads"),
    decoder="xattn_gpt",
    build=vima,
)


GATO = PublishedAdapter(
    "gato",
    (*SHARED_RULES, *vit_rules("images"), *PREFIX_RULES),
    cfg_names=("embed_dim", "n_layer", "n_head"),
    decoder="transformer.lm",
    build=gato,
)


def _resampler_layer(published: str, ours: str) -> tuple[Rule, ...]:
    return (
        Rule(f"{published}.attention.self.layernorm1", f"{ours}.norm_attention"),
        Rule(f"{published}.attention.self.layernorm2", f"{ours}.norm_source"),
        Rule(f"{published}.attention.self.query", f"{ours}.query"),
        Rule(f"{published}.attention.self.key", f"{ours}.key"),
        Rule(f"{published}.attention.self.value", f"{ours}.value"),
        Rule(f"{published}.attention.output.dense", f"{ours}.attention_out"),
        Rule(f"{published}.layernorm", f"{ours}.norm_feed_forward"),
        Rule(f"{published}.mlp.dense1", f"{ours}.hidden"),
        Rule(f"{published}.mlp.dense2", f"{ours}.out"),
    )


PERCEIVER = "obj_encoder.peceiver.model"  # spelled like this in the files
_RESAMPLER_RULES = (
    Rule(f"{PERCEIVER}.embeddings.latents", "resampler.latents"),
    *_resampler_layer(f"{PERCEIVER}.encoder.cross_attention", "resampler.cross_layer"),
    *_resampler_layer(f"{PERCEIVER}.encoder.self_attends.*", "resampler.self_layers.*"),
)
FLAMINGO = PublishedAdapter(
    "flamingo",
    (*SHARED_RULES, *vit_rules("images"), *_RESAMPLER_RULES, *CROSS_ATTENTION_RULES),
    cfg_names=("embed_dim", "dt_n_layers", "dt_n_heads", "xattn_n_heads"),
    decoder="xattn_gpt",
    build=flamingo,
)


GPT = PublishedAdapter(
    "gpt",
    (*SHARED_RULES, *vit_rules("images"), *PREFIX_RULES),
    cfg_names=("embed_dim", "n_layer", "n_head"),
    decoder="transformer.lm",
    build=gpt,
)


PREFIX = "policy."  # before every name in a file
ADAPTERS = {adapter.architecture: adapter for adapter in (VIMA, GATO, FLAMINGO, GPT)}
# Unused position counters, masks and embeddings of the files.
_UNUSED = re.compile(
    r"(xattn_gpt|transformer\.lm)\.(position_ids|xattn_position_ids|h\.\d+\.attn\.bias)"
    r"|xattn_gpt\.xattns\.\d+\.kv_position_ids"
    r"|transformer\.lm\.tokens_embed\.weight"
    r"|t5_prompt_encoder\.t5\.(shared|encoder\.embed_tokens)\.weight"
)


def is_unused(name: str) -> bool:
    """Whether a published name, without prefix, is an unused entry."""
    return _UNUSED.fullmatch(name) is not None


def without_prefix(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Remove the prefix `policy.` from the names of published weights."""
    return {name.removeprefix(PREFIX): tensor for name, tensor in weights.items()}


def adapter_of(weights: Iterable[str]) -> PublishedAdapter:
    """Recognise the architecture of weights by their published names.

    Raises:
        CheckpointError: It is none of the four.
    """
    names = {name.removeprefix(PREFIX) for name in weights}
    if any(name.startswith("obj_encoder.bbox_mlp.") for name in names):
        return VIMA
    if any(name.startswith(f"{PERCEIVER}.") for name in names):
        return FLAMINGO
    if any(name.startswith("transformer.lm.") for name in names):
        return GPT if "obj_encoder.cropped_img_encoder.vit.cls_token" in names else GATO
    raise CheckpointError(
        "these are no weights of VIMA, VIMA-Gato, VIMA-Flamingo or VIMA-GPT: no name begins with "
        f"obj_encoder.bbox_mlp, {PERCEIVER} or transformer.lm."
    )


def from_published(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename published weights to their names in this package.

    Args:
        weights: Weights by published name, with or without the prefix `policy.`.

    Returns:
        Weights in float32, matrices as (out, in). Unused entries are dropped; unknown names are unchanged.

    Raises:
        CheckpointError: The names are not those of VIMA or one of its baselines.
    """
    adapter = adapter_of(weights)
    result = {}
    for name, tensor in without_prefix(weights).items():
        if not is_unused(name):
            ours, transposed = to_ours(adapter.rules, name) or (name, False)
            result[ours] = _converted(tensor, transposed)
    return result


def to_published(network: PolicyNetwork) -> dict[str, torch.Tensor]:
    """Give the weights of a network their published names, without `policy.` before them.

    Numbers of heads are not in the weights; a file gives those of the decoder in its `cfg`, and all image
    encoders have 24.

    Args:
        network: Of the published architecture, in any size, with or without weights.

    Returns:
        Weights in float32, matrices as they are published. They may share memory with the network.

    Raises:
        CheckpointError: The network has parts that no published policy has.
    """
    adapter = ADAPTERS.get(network.config.architecture, VIMA)
    result, without_name = {}, []
    for ours, tensor in network.state_dict().items():
        renamed = to_theirs(adapter.rules, ours)
        if renamed is None:
            without_name.append(ours)
        else:
            name, transposed = renamed
            result[name] = _converted(tensor, transposed)
    if without_name:
        raise CheckpointError(
            f"this network has parts that no published policy has: {', '.join(without_name)}. "
            "Only presets of the form vima-…, gato-…, flamingo-… and gpt-… have published names."
        )
    return result


def _converted(tensor: torch.Tensor, transposed: bool) -> torch.Tensor:
    tensor = tensor.detach()
    tensor = tensor.float() if tensor.is_floating_point() else tensor
    return (tensor.T if transposed and tensor.ndim == 2 else tensor).contiguous()
