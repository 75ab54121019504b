"""Names of weights in published files beside their names here, as one table for each policy.

`*` stands for a number; a name stands for itself and for its `.weight` and `.bias`.
"""

import re
from dataclasses import dataclass
from functools import cache
from typing import Literal

from openvima.policies.nn.action_encoder import ACTION_PARTS

Family = Literal["vima", "gato", "flamingo", "gpt"]


@dataclass(frozen=True, slots=True)
class Rule:
    """One line of the table.

    Args:
        published: Name in a published file.
        ours: Name in `PolicyNetwork`.
        transposed: Whether the file holds the matrix as (in, out).
    """

    published: str
    ours: str
    transposed: bool = False


def _stack(published: str, ours: str, num_layers: int) -> tuple[Rule, ...]:
    """A stack of linear layers: there two layers without weights lie between them, here one."""
    return tuple(Rule(f"{published}.{3 * i}", f"{ours}.{2 * i}") for i in range(num_layers))


def _vit(ours: str) -> tuple[Rule, ...]:
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
        Rule(f"{published}.positions_embed", "trunk.positions"),
        Rule(f"{published}.h.*.attn.c_attn", "trunk.self_blocks.*.query_key_value", transposed=True),
        Rule(f"{published}.h.*.attn.c_proj", "trunk.self_blocks.*.attention_out", transposed=True),
        Rule(f"{published}.h.*.ln_1", "trunk.self_blocks.*.norm_attention"),
        Rule(f"{published}.h.*.mlp.c_fc", "trunk.self_blocks.*.widen", transposed=True),
        Rule(f"{published}.h.*.mlp.c_proj", "trunk.self_blocks.*.narrow", transposed=True),
        Rule(f"{published}.h.*.mlp.gated_layer", "trunk.self_blocks.*.gate"),
        Rule(f"{published}.h.*.ln_2", "trunk.self_blocks.*.norm_feed_forward"),
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
_RESAMPLER = (
    Rule(f"{PERCEIVER}.embeddings.latents", "images.resampler.latents"),
    *_resampler_layer(f"{PERCEIVER}.encoder.cross_attention", "images.resampler.cross_layer"),
    *_resampler_layer(f"{PERCEIVER}.encoder.self_attends.*", "images.resampler.self_layers.*"),
)
_OBJECTS = (
    *_stack("obj_encoder.bbox_mlp.front", "images.box_encoders.0", 3),
    *_stack("obj_encoder.bbox_mlp.top", "images.box_encoders.1", 3),
    Rule("obj_encoder.pre_transformer_layer.front", "images.fusion.0"),
    Rule("obj_encoder.pre_transformer_layer.top", "images.fusion.1"),
)
T5 = "t5_prompt_encoder.t5.encoder"
_PROMPT = (
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
    *_stack("prompt_obj_post_layer", "prompt.images", 3),
)
_ACTIONS = (
    *(
        rule
        for part, name in enumerate(ACTION_PARTS)
        for rule in _stack(f"action_encoder._embed_dict.{name}._layer", f"actions.parts.{part}", 2)
    ),
    Rule("action_encoder._post_layer", "actions.out"),
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
    Rule("end_effector_encoder", "end_effectors"),
    Rule("obs_fusion_layer", "observation_out"),
)
_DECODER = (
    *_self_blocks("xattn_gpt"),
    Rule("xattn_gpt.xattn_positions_embed", "trunk.prompt_positions"),
    Rule("xattn_gpt.xattns.*.layernorm", "trunk.cross_blocks.*.norm_attention"),
    Rule("xattn_gpt.xattns.*.query", "trunk.cross_blocks.*.query"),
    Rule("xattn_gpt.xattns.*.key_value", "trunk.cross_blocks.*.key_value"),
    Rule("xattn_gpt.xattns.*.attention_out", "trunk.cross_blocks.*.attention_out"),
    Rule("xattn_gpt.xattns.*.ln", "trunk.cross_blocks.*.norm_feed_forward"),
    Rule("xattn_gpt.xattns.*.linear1", "trunk.cross_blocks.*.widen"),
    Rule("xattn_gpt.xattns.*.linear2", "trunk.cross_blocks.*.narrow"),
    Rule("xattn_gpt.xattns.*.gated_layer", "trunk.cross_blocks.*.gate"),
)
_PREFIX_TRUNK = (
    *_self_blocks("transformer.lm"),
    Rule("prompt_sep_token", "trunk.separator"),
)
TABLES: dict[Family, tuple[Rule, ...]] = {
    "vima": (*_SHARED, *_vit("images.crop_encoder"), *_OBJECTS, *_DECODER),
    "gato": (*_SHARED, *_vit("images.frame_encoder"), *_PREFIX_TRUNK),
    "flamingo": (*_SHARED, *_vit("images.frame_encoder"), *_RESAMPLER, *_DECODER),
    "gpt": (*_SHARED, *_vit("images.frame_encoder"), *_PREFIX_TRUNK),
}


def to_ours(family: Family, name: str) -> tuple[str, bool] | None:
    """Return our name of a published weight and whether to transpose it; None if there is no such weight."""
    return _renamed(name, [(rule.published, rule.ours, rule.transposed) for rule in TABLES[family]])


def to_theirs(family: Family, name: str) -> tuple[str, bool] | None:
    """Return the published name of one of our weights and whether to transpose it; None if it has none."""
    return _renamed(name, [(rule.ours, rule.published, rule.transposed) for rule in TABLES[family]])


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
