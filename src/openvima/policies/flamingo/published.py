"""Published files of VIMA-Flamingo."""

from openvima.policies.flamingo.config import flamingo
from openvima.policies.published.rules import (
    CROSS_ATTENTION_RULES,
    SHARED_RULES,
    PublishedAdapter,
    Rule,
    vit_rules,
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
ADAPTER = PublishedAdapter(
    "flamingo",
    (*SHARED_RULES, *vit_rules("images"), *_RESAMPLER_RULES, *CROSS_ATTENTION_RULES),
    cfg_names=("embed_dim", "dt_n_layers", "dt_n_heads", "xattn_n_heads"),
    decoder="xattn_gpt",
    build=flamingo,
)
