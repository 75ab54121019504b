"""Published files of VIMA-GPT."""

from openvima.policies.gpt.config import gpt
from openvima.policies.published.rules import PREFIX_RULES, SHARED_RULES, PublishedAdapter, vit_rules

ADAPTER = PublishedAdapter(
    "gpt",
    (*SHARED_RULES, *vit_rules("images"), *PREFIX_RULES),
    cfg_names=("embed_dim", "n_layer", "n_head"),
    decoder="transformer.lm",
    build=gpt,
)
