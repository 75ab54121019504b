"""openvima-small with `hides_likeness`, without new training.

    openvima evaluate --policy hidden=experiments/openvima_small/hidden_likeness.py:make \
        --tasks same_shape,same_texture --levels L1,L4 --ablations swapped_attribute --out hidden

Where a prompt selects attributes, the decoder then sees neither sizes of boxes nor correspondence. What
success with the swapped attribute loses by that was due to these.
"""

from dataclasses import replace

from openvima.policies.build import build_network
from openvima.policies.checkpoint import load_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.pointer.config import PointerConfig
from openvima.policies.t5 import tokenizer_for


def make() -> NetworkPolicy:
    """Load the bundled weights into a network that hides likeness."""
    trained, vocabulary = load_network("openvima-small")
    config = trained.config
    assert isinstance(config, PointerConfig) and config.attributes
    config = replace(config, attributes=replace(config.attributes, hides_likeness=True))
    network = build_network(config, seed=0)
    network.load_state_dict(trained.state_dict())
    return NetworkPolicy(network, tokenizer=tokenizer_for(config.prompt, vocabulary))
