"""Names of weights in published files, and of the same weights here.

One table serves both directions. In it `*` stands for a number, and a name stands for itself and for its
`.weight` and `.bias`.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

import torch

from openvima.errors import CheckpointError
from openvima.policies.layers.action_encoder import ACTION_PARTS
from openvima.policies.layers.frame_encoder import FrameEncoder
from openvima.policies.layers.object_encoder import ObjectEncoder
from openvima.policies.layers.trunk import MAX_PLACES, MAX_PROMPT_PLACES
from openvima.policies.network import PolicyNetwork

Family = Literal["vima", "gato", "flamingo", "gpt"]

PREFIX = "policy."  # before every name in a file
_OLD_GPT_VOCABULARY_SIZE = 40478  # words of the first GPT, whose unused embedding is in files of its kind


@dataclass(frozen=True, slots=True)
class _Rule:
    """One line of the table.

    Args:
        published: Name in a published file.
        ours: Name in `PolicyNetwork`.
        transposed: Whether the file holds the matrix as (in, out).
    """

    published: str
    ours: str
    transposed: bool = False


def _stack(published: str, ours: str, num_layers: int) -> tuple[_Rule, ...]:
    """A stack of linear layers: there two layers without weights lie between them, here one."""
    return tuple(_Rule(f"{published}.{3 * i}", f"{ours}.{2 * i}") for i in range(num_layers))


def _vit(ours: str) -> tuple[_Rule, ...]:
    published = "obj_encoder.cropped_img_encoder.vit"
    return (
        _Rule(f"{published}.cls_token", f"{ours}.class_token"),
        _Rule(f"{published}.pos_embed", f"{ours}.positions"),
        _Rule(f"{published}.projection", f"{ours}.projection.weight", transposed=True),
        _Rule(f"{published}.conv1", f"{ours}.patches"),
        _Rule(f"{published}.ln_pre", f"{ours}.norm_before"),
        _Rule(f"{published}.ln_post", f"{ours}.norm_after"),
        _Rule(f"{published}.blocks.*.attn.in_proj_weight", f"{ours}.blocks.*.query_key_value.weight"),
        _Rule(f"{published}.blocks.*.attn.in_proj_bias", f"{ours}.blocks.*.query_key_value.bias"),
        _Rule(f"{published}.blocks.*.attn.out_proj", f"{ours}.blocks.*.attention_out"),
        _Rule(f"{published}.blocks.*.ln_1", f"{ours}.blocks.*.norm_attention"),
        _Rule(f"{published}.blocks.*.ln_2", f"{ours}.blocks.*.norm_mlp"),
        _Rule(f"{published}.blocks.*.mlp.c_fc", f"{ours}.blocks.*.widen"),
        _Rule(f"{published}.blocks.*.mlp.c_proj", f"{ours}.blocks.*.narrow"),
    )


def _self_blocks(published: str) -> tuple[_Rule, ...]:
    return (
        _Rule(f"{published}.positions_embed", "trunk.positions"),
        _Rule(f"{published}.h.*.attn.c_attn", "trunk.self_blocks.*.query_key_value", transposed=True),
        _Rule(f"{published}.h.*.attn.c_proj", "trunk.self_blocks.*.attention_out", transposed=True),
        _Rule(f"{published}.h.*.ln_1", "trunk.self_blocks.*.norm_attention"),
        _Rule(f"{published}.h.*.mlp.c_fc", "trunk.self_blocks.*.widen", transposed=True),
        _Rule(f"{published}.h.*.mlp.c_proj", "trunk.self_blocks.*.narrow", transposed=True),
        _Rule(f"{published}.h.*.mlp.gated_layer", "trunk.self_blocks.*.gate"),
        _Rule(f"{published}.h.*.ln_2", "trunk.self_blocks.*.norm_feed_forward"),
    )


def _resampler_layer(published: str, ours: str) -> tuple[_Rule, ...]:
    return (
        _Rule(f"{published}.attention.self.layernorm1", f"{ours}.norm_attention"),
        _Rule(f"{published}.attention.self.layernorm2", f"{ours}.norm_source"),
        _Rule(f"{published}.attention.self.query", f"{ours}.query"),
        _Rule(f"{published}.attention.self.key", f"{ours}.key"),
        _Rule(f"{published}.attention.self.value", f"{ours}.value"),
        _Rule(f"{published}.attention.output.dense", f"{ours}.attention_out"),
        _Rule(f"{published}.layernorm", f"{ours}.norm_feed_forward"),
        _Rule(f"{published}.mlp.dense1", f"{ours}.hidden"),
        _Rule(f"{published}.mlp.dense2", f"{ours}.out"),
    )


_PERCEIVER = "obj_encoder.peceiver.model"  # spelled like this in the files
_RESAMPLER = (
    _Rule(f"{_PERCEIVER}.embeddings.latents", "images.resampler.latents"),
    *_resampler_layer(f"{_PERCEIVER}.encoder.cross_attention", "images.resampler.cross_layer"),
    *_resampler_layer(f"{_PERCEIVER}.encoder.self_attends.*", "images.resampler.self_layers.*"),
)
_OBJECTS = (
    *_stack("obj_encoder.bbox_mlp.front", "images.box_encoders.0", 3),
    *_stack("obj_encoder.bbox_mlp.top", "images.box_encoders.1", 3),
    _Rule("obj_encoder.pre_transformer_layer.front", "images.fusion.0"),
    _Rule("obj_encoder.pre_transformer_layer.top", "images.fusion.1"),
)
_T5 = "t5_prompt_encoder.t5.encoder"
_PROMPT = (
    _Rule("prompt_embedding._embed_layer", "prompt.words"),
    _Rule(f"{_T5}.block.0.layer.0.SelfAttention.relative_attention_bias", "prompt.text.position_bias"),
    _Rule(f"{_T5}.block.*.layer.0.layer_norm", "prompt.text.blocks.*.norm_attention"),
    _Rule(f"{_T5}.block.*.layer.0.SelfAttention.q", "prompt.text.blocks.*.query"),
    _Rule(f"{_T5}.block.*.layer.0.SelfAttention.k", "prompt.text.blocks.*.key"),
    _Rule(f"{_T5}.block.*.layer.0.SelfAttention.v", "prompt.text.blocks.*.value"),
    _Rule(f"{_T5}.block.*.layer.0.SelfAttention.o", "prompt.text.blocks.*.attention_out"),
    _Rule(f"{_T5}.block.*.layer.1.layer_norm", "prompt.text.blocks.*.norm_feed_forward"),
    _Rule(f"{_T5}.block.*.layer.1.DenseReluDense.wi", "prompt.text.blocks.*.widen"),
    _Rule(f"{_T5}.block.*.layer.1.DenseReluDense.wo", "prompt.text.blocks.*.narrow"),
    _Rule(f"{_T5}.final_layer_norm", "prompt.text.norm_after"),
    _Rule("t5_prompt_encoder_post_layer", "prompt.out"),
    *_stack("prompt_obj_post_layer", "prompt.images", 3),
)
_ACTIONS = (
    *(
        rule
        for part, name in enumerate(ACTION_PARTS)
        for rule in _stack(f"action_encoder._embed_dict.{name}._layer", f"actions.parts.{part}", 2)
    ),
    _Rule("action_encoder._post_layer", "actions.out"),
    *(
        rule
        for name, components in ACTION_PARTS.items()
        for i, component in enumerate(range(components.start, components.stop))
        for rule in _stack(f"action_decoder._decoders.{name}.mlps.{i}", f"head.classifiers.{component}", 3)
    ),
)
_SHARED = (
    *_PROMPT,
    *_ACTIONS,
    _Rule("end_effector_encoder", "end_effectors"),
    _Rule("obs_fusion_layer", "observation_out"),
)
_DECODER = (
    *_self_blocks("xattn_gpt"),
    _Rule("xattn_gpt.xattn_positions_embed", "trunk.prompt_positions"),
    _Rule("xattn_gpt.xattns.*.layernorm", "trunk.cross_blocks.*.norm_attention"),
    _Rule("xattn_gpt.xattns.*.query", "trunk.cross_blocks.*.query"),
    _Rule("xattn_gpt.xattns.*.key_value", "trunk.cross_blocks.*.key_value"),
    _Rule("xattn_gpt.xattns.*.attention_out", "trunk.cross_blocks.*.attention_out"),
    _Rule("xattn_gpt.xattns.*.ln", "trunk.cross_blocks.*.norm_feed_forward"),
    _Rule("xattn_gpt.xattns.*.linear1", "trunk.cross_blocks.*.widen"),
    _Rule("xattn_gpt.xattns.*.linear2", "trunk.cross_blocks.*.narrow"),
    _Rule("xattn_gpt.xattns.*.gated_layer", "trunk.cross_blocks.*.gate"),
)
_PREFIX_TRUNK = (
    *_self_blocks("transformer.lm"),
    _Rule("prompt_sep_token", "trunk.separator"),
)
_TABLES: dict[Family, tuple[_Rule, ...]] = {
    "vima": (*_SHARED, *_vit("images.crop_encoder"), *_OBJECTS, *_DECODER),
    "gato": (*_SHARED, *_vit("images.frame_encoder"), *_PREFIX_TRUNK),
    "flamingo": (*_SHARED, *_vit("images.frame_encoder"), *_RESAMPLER, *_DECODER),
    "gpt": (*_SHARED, *_vit("images.frame_encoder"), *_PREFIX_TRUNK),
}
# Counters, masks and embeddings that the published code keeps in its files and never looks at.
_DEAD = re.compile(
    r"(xattn_gpt|transformer\.lm)\.(position_ids|xattn_position_ids|h\.\d+\.attn\.bias)"
    r"|xattn_gpt\.xattns\.\d+\.kv_position_ids"
    r"|transformer\.lm\.tokens_embed\.weight"
    r"|t5_prompt_encoder\.t5\.(shared|encoder\.embed_tokens)\.weight"
)


def is_dead(name: str) -> bool:
    """Whether a published name, without prefix, is that of an entry which has no effect."""
    return _DEAD.fullmatch(name) is not None


def without_prefix(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return published weights without the `policy.` that stands before every name in a file."""
    return {name.removeprefix(PREFIX): tensor for name, tensor in weights.items()}


def family_of(names: Iterable[str]) -> Family:
    """Tell which policy has weights of these published names.

    Raises:
        CheckpointError: None of the four has.
    """
    names = {name.removeprefix(PREFIX) for name in names}
    if any(name.startswith("obj_encoder.bbox_mlp.") for name in names):
        return "vima"
    if any(name.startswith(_PERCEIVER) for name in names):
        return "flamingo"
    if any(name.startswith("transformer.lm.") for name in names):
        return "gpt" if "obj_encoder.cropped_img_encoder.vit.cls_token" in names else "gato"
    raise CheckpointError(
        "these are no weights of VIMA, VIMA-Gato, VIMA-Flamingo or VIMA-GPT: none of them has a name that "
        "tells one of these apart, such as 'obj_encoder.bbox_mlp.front.0.weight'."
    )


def from_published(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename published weights to what `PolicyNetwork` calls them.

    Args:
        weights: Weights by published name, with or without `policy.` before it.

    Returns:
        Weights in float32, matrices as (out, in). Entries without effect are left out; names that no
        published policy has stay as they are.

    Raises:
        CheckpointError: The names are not those of VIMA or one of its baselines.
    """
    family = family_of(weights)
    result = {}
    for name, tensor in without_prefix(weights).items():
        if not is_dead(name):
            ours, transposed = _to_ours(family, name) or (name, False)
            result[ours] = _converted(tensor, transposed)
    return result


def to_published(network: PolicyNetwork, *, dead_entries: bool = False) -> dict[str, torch.Tensor]:
    """Give the weights of a network their published names, without `policy.` before them.

    Args:
        network: One of the published architecture, of any size.
        dead_entries: Add the entries without effect, which the published code demands.

    Returns:
        Weights in float32, matrices as they are published. They may share memory with the network.

    Raises:
        CheckpointError: The network has parts that no published policy has.
    """
    family = _family(network)
    result, without_name = {}, []
    for ours, tensor in network.state_dict().items():
        renamed = _to_published(family, ours)
        if renamed is None:
            without_name.append(ours)
        else:
            name, transposed = renamed
            result[name] = _converted(tensor, transposed)
    if without_name:
        raise CheckpointError(
            f"this network is none of the published ones: they have no {', '.join(without_name)}. "
            "Only the presets vima-*, gato-*, flamingo-* and gpt-* have published names."
        )
    return {**result, **_dead_entries(network)} if dead_entries else result


def _family(network: PolicyNetwork) -> Family:
    if isinstance(network.images, ObjectEncoder):
        return "vima"
    assert isinstance(network.images, FrameEncoder)
    families: dict[str, Family] = {"patches": "gato", "resampled": "flamingo", "class": "gpt"}
    return families[network.images.config.readout]


def _dead_entries(network: PolicyNetwork) -> dict[str, torch.Tensor]:
    """Entries without effect as the published code makes them; unused embeddings are those in use, or 0."""
    words = network.prompt.words.weight.detach()
    places = torch.arange(MAX_PLACES, device=words.device)
    prompt_places = torch.arange(MAX_PROMPT_PLACES, device=words.device)
    words = words.float()
    entries = {
        "t5_prompt_encoder.t5.shared.weight": words,
        f"{_T5}.embed_tokens.weight": words,
    }
    blocks = range(len(network.trunk.self_blocks))
    if _family(network) in ("gato", "gpt"):
        shape = (_OLD_GPT_VOCABULARY_SIZE, network.trunk.width)
        entries["transformer.lm.position_ids"] = places
        entries["transformer.lm.tokens_embed.weight"] = words.new_zeros(shape)
        return entries
    causal = words.new_ones(1, 1, MAX_PLACES, MAX_PLACES).tril()
    entries["xattn_gpt.position_ids"] = places
    entries["xattn_gpt.xattn_position_ids"] = prompt_places
    entries |= {f"xattn_gpt.h.{block}.attn.bias": causal for block in blocks}
    entries |= {f"xattn_gpt.xattns.{block}.kv_position_ids": prompt_places for block in blocks}
    return entries


def _converted(tensor: torch.Tensor, transposed: bool) -> torch.Tensor:
    tensor = tensor.detach()
    tensor = tensor.float() if tensor.is_floating_point() else tensor
    return tensor.T.contiguous() if transposed and tensor.ndim == 2 else tensor


def _to_ours(family: Family, name: str) -> tuple[str, bool] | None:
    """Our name of a published one, and whether the matrix is to be transposed; None if there is none."""
    return _renamed(name, ((rule.published, rule.ours, rule.transposed) for rule in _TABLES[family]))


def _to_published(family: Family, name: str) -> tuple[str, bool] | None:
    """The inverse of `_to_ours`."""
    return _renamed(name, ((rule.ours, rule.published, rule.transposed) for rule in _TABLES[family]))


def _renamed(name: str, table: Iterable[tuple[str, str, bool]]) -> tuple[str, bool] | None:
    for before, after, transposed in table:
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
