"""Published files of VIMA."""

from openvima.policies.published.rules import (
    CROSS_ATTENTION_RULES,
    SHARED_RULES,
    PublishedAdapter,
    Rule,
    stack_rules,
    vit_rules,
)
from openvima.policies.vima.config import vima

_OBJECT_RULES = (
    *stack_rules("obj_encoder.bbox_mlp.front", "images.box_encoders.0", 3),
    *stack_rules("obj_encoder.bbox_mlp.top", "images.box_encoders.1", 3),
    Rule("obj_encoder.pre_transformer_layer.front", "images.fusion.0"),
    Rule("obj_encoder.pre_transformer_layer.top", "images.fusion.1"),
)
ADAPTER = PublishedAdapter(
    "vima",
    (*SHARED_RULES, *vit_rules("images.crop_encoder"), *_OBJECT_RULES, *CROSS_ATTENTION_RULES),
    cfg_names=("embed_dim", "xf_n_layers", "sattn_n_heads", "xattn_n_heads"),
    decoder="xattn_gpt",
    build=vima,
)
