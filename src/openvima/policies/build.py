"""Build networks from their configs."""

import torch

from openvima.policies.config import PolicyConfig
from openvima.policies.flamingo.model import Flamingo
from openvima.policies.gato.model import Gato
from openvima.policies.gpt.model import Gpt
from openvima.policies.limits import check_limits
from openvima.policies.midas.model import Midas
from openvima.policies.nn.meta_init import MetaInit
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.pointer.model import Pointer
from openvima.policies.vima.model import Vima

MODELS: dict[str, type[PolicyNetwork]] = {
    "vima": Vima,
    "gato": Gato,
    "flamingo": Flamingo,
    "gpt": Gpt,
    "midas": Midas,
    "pointer": Pointer,
}


def build_network(config: PolicyConfig, *, seed: int) -> PolicyNetwork:
    """Build a network with fresh weights from a seed, leaving the global random state unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return MODELS[config.architecture](config)


def outline_network(config: PolicyConfig) -> PolicyNetwork:
    """Build a network on the meta device, to count parameters or to assign weights.

    It allocates no memory. `network.load_state_dict(weights, assign=True)` makes it usable.

    Raises:
        ConfigError: A size lies beyond its limit.
    """
    check_limits(config, "policy")
    with MetaInit():
        return MODELS[config.architecture](config)
