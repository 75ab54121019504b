"""Published files of VIMA-Gato."""

from openvima.policies.gato.config import gato
from openvima.policies.published.rules import PREFIX_RULES, SHARED_RULES, PublishedAdapter, vit_rules

ADAPTER = PublishedAdapter(
    "gato",
    (*SHARED_RULES, *vit_rules("images"), *PREFIX_RULES),
    cfg_names=("embed_dim", "n_layer", "n_head"),
    decoder="transformer.lm",
    build=gato,
)
