"""openvima-small with exclusive attributes, without new training.

    openvima evaluate --policy exclusive=experiments/openvima_small/exclusive_attributes.py:make \
        --tasks same_shape,same_texture --levels L1,L4 --ablations swapped_attribute --out exclusive

Where a prompt selects attributes, the decoder then sees no sizes of boxes, and correspondence compares
objects by these attributes alone. What success with the swapped attribute loses by that was due to the rest.
"""

from dataclasses import replace

from openvima.policies.build import build_network
from openvima.policies.checkpoint import load_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.pointer.config import PointerConfig
from openvima.policies.t5 import tokenizer_for


def make() -> NetworkPolicy:
    """Load the bundled weights into a network with exclusive attributes."""
    trained, vocabulary = load_network("openvima-small")
    config = trained.config
    assert isinstance(config, PointerConfig) and config.attributes
    config = replace(config, attributes=replace(config.attributes, exclusive=True))
    network = build_network(config, seed=0)
    network.load_state_dict(trained.state_dict())
    return NetworkPolicy(network, tokenizer=tokenizer_for(config.prompt, vocabulary))
