"""Published names of weights, mapped to the names of this package, for the golden tests."""

import re

import torch

_RULES: tuple[tuple[str, str], ...] = (
    (r"xattn_gpt\.positions_embed\.", "trunk.positions."),
    (r"xattn_gpt\.xattn_positions_embed\.", "trunk.prompt_positions."),
    (r"xattn_gpt\.h\.(\d+)\.attn\.c_attn\.", r"trunk.self_blocks.\1.query_key_value."),
    (r"xattn_gpt\.h\.(\d+)\.attn\.c_proj\.", r"trunk.self_blocks.\1.attention_out."),
    (r"xattn_gpt\.h\.(\d+)\.ln_1\.", r"trunk.self_blocks.\1.norm_attention."),
    (r"xattn_gpt\.h\.(\d+)\.ln_2\.", r"trunk.self_blocks.\1.norm_feed_forward."),
    (r"xattn_gpt\.h\.(\d+)\.mlp\.c_fc\.", r"trunk.self_blocks.\1.widen."),
    (r"xattn_gpt\.h\.(\d+)\.mlp\.c_proj\.", r"trunk.self_blocks.\1.narrow."),
    (r"xattn_gpt\.h\.(\d+)\.mlp\.gated_layer\.", r"trunk.self_blocks.\1.gate."),
    (r"xattn_gpt\.xattns\.(\d+)\.layernorm\.", r"trunk.cross_blocks.\1.norm_attention."),
    (r"xattn_gpt\.xattns\.(\d+)\.ln\.", r"trunk.cross_blocks.\1.norm_feed_forward."),
    (r"xattn_gpt\.xattns\.(\d+)\.linear1\.", r"trunk.cross_blocks.\1.widen."),
    (r"xattn_gpt\.xattns\.(\d+)\.linear2\.", r"trunk.cross_blocks.\1.narrow."),
    (r"xattn_gpt\.xattns\.(\d+)\.gated_layer\.", r"trunk.cross_blocks.\1.gate."),
    (r"xattn_gpt\.xattns\.(\d+)\.(query|key_value|attention_out)\.", r"trunk.cross_blocks.\1.\2."),
    (r"obj_encoder\.cropped_img_encoder\.vit\.", "images.crop_encoder."),
    (r"crop_encoder\.cls_token", "crop_encoder.class_token"),
    (r"crop_encoder\.pos_embed", "crop_encoder.positions"),
    (r"crop_encoder\.projection", "crop_encoder.projection.weight"),
    (r"crop_encoder\.conv1\.", "crop_encoder.patches."),
    (r"crop_encoder\.ln_pre\.", "crop_encoder.norm_before."),
    (r"crop_encoder\.ln_post\.", "crop_encoder.norm_after."),
    (r"crop_encoder\.blocks\.(\d+)\.attn\.in_proj_", r"crop_encoder.blocks.\1.query_key_value."),
    (r"crop_encoder\.blocks\.(\d+)\.attn\.out_proj\.", r"crop_encoder.blocks.\1.attention_out."),
    (r"crop_encoder\.blocks\.(\d+)\.ln_1\.", r"crop_encoder.blocks.\1.norm_attention."),
    (r"crop_encoder\.blocks\.(\d+)\.ln_2\.", r"crop_encoder.blocks.\1.norm_mlp."),
    (r"crop_encoder\.blocks\.(\d+)\.mlp\.c_fc\.", r"crop_encoder.blocks.\1.widen."),
    (r"crop_encoder\.blocks\.(\d+)\.mlp\.c_proj\.", r"crop_encoder.blocks.\1.narrow."),
    (r"obj_encoder\.bbox_mlp\.front\.", "images.box_encoders.0."),
    (r"obj_encoder\.bbox_mlp\.top\.", "images.box_encoders.1."),
    (r"obj_encoder\.pre_transformer_layer\.front\.", "images.fusion.0."),
    (r"obj_encoder\.pre_transformer_layer\.top\.", "images.fusion.1."),
    (r"end_effector_encoder\.", "end_effectors."),
    (r"obs_fusion_layer\.", "observation_out."),
    (r"action_encoder\._embed_dict\.pose0_position\._layer\.", "actions.parts.0."),
    (r"action_encoder\._embed_dict\.pose0_rotation\._layer\.", "actions.parts.1."),
    (r"action_encoder\._embed_dict\.pose1_position\._layer\.", "actions.parts.2."),
    (r"action_encoder\._embed_dict\.pose1_rotation\._layer\.", "actions.parts.3."),
    (r"action_encoder\._post_layer\.", "actions.out."),
    (r"prompt_embedding\._embed_layer\.", "prompt.words."),
    (r"t5_prompt_encoder_post_layer\.", "prompt.out."),
    (r"prompt_obj_post_layer\.", "prompt.images."),
    (r"t5_prompt_encoder\.t5\.encoder\.final_layer_norm\.", "prompt.text.norm_after."),
    (
        r"t5_prompt_encoder\.t5\.encoder\.block\.0\.layer\.0\.SelfAttention\.relative_attention_bias\.",
        "prompt.text.position_bias.",
    ),
    (
        r"t5_prompt_encoder\.t5\.encoder\.block\.(\d+)\.layer\.0\.SelfAttention\.([qkvo])\.",
        r"prompt.text.blocks.\1.attn_\2.",
    ),
    (r"\.attn_q\.", ".query."),
    (r"\.attn_k\.", ".key."),
    (r"\.attn_v\.", ".value."),
    (r"\.attn_o\.", ".attention_out."),
    (
        r"t5_prompt_encoder\.t5\.encoder\.block\.(\d+)\.layer\.0\.layer_norm\.",
        r"prompt.text.blocks.\1.norm_attention.",
    ),
    (
        r"t5_prompt_encoder\.t5\.encoder\.block\.(\d+)\.layer\.1\.layer_norm\.",
        r"prompt.text.blocks.\1.norm_feed_forward.",
    ),
    (
        r"t5_prompt_encoder\.t5\.encoder\.block\.(\d+)\.layer\.1\.DenseReluDense\.wi\.",
        r"prompt.text.blocks.\1.widen.",
    ),
    (
        r"t5_prompt_encoder\.t5\.encoder\.block\.(\d+)\.layer\.1\.DenseReluDense\.wo\.",
        r"prompt.text.blocks.\1.narrow.",
    ),
)
_STACKS = r"(images\.box_encoders\.\d|actions\.parts\.\d|prompt\.images|head\.classifiers\.\d+)\.(\d)\."
_FIRST_CLASSIFIER = {"pose0_position": 0, "pose0_rotation": 2, "pose1_position": 6, "pose1_rotation": 8}
_IN_OUT = re.compile(r"xattn_gpt\.h\.\d+\.(attn|mlp)\.c_\w+\.weight|vit\.projection")
_DEAD = re.compile(r"position_ids|\.attn\.bias$|t5\.shared|embed_tokens")


def translated(weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename and, where stored (in, out), transpose the published weights; dead entries fall away."""
    result = {}
    for name, tensor in weights.items():
        if _DEAD.search(name):
            continue
        tensor = tensor.float()
        result[_renamed(name)] = tensor.T.contiguous() if _IN_OUT.search(name) else tensor
    return result


def _renamed(name: str) -> str:
    head = re.match(r"action_decoder\._decoders\.(\w+)\.mlps\.(\d+)\.(.*)", name)
    if head:
        key, dimension, rest = head.groups()
        name = f"head.classifiers.{_FIRST_CLASSIFIER[key] + int(dimension)}.{rest}"
    for pattern, replacement in _RULES:
        name = re.sub(pattern, replacement, name)
    # Published stacks count an identity per layer: 0, 3, 6 there are 0, 2, 4 here.
    return re.sub(_STACKS, lambda match: f"{match[1]}.{int(match[2]) // 3 * 2}.", name)
