"""Convert weights between published names and ours."""

import re
from collections.abc import Iterable, Mapping

import torch

from openvima.errors import CheckpointError
from openvima.policies.flamingo.published import ADAPTER as FLAMINGO
from openvima.policies.flamingo.published import PERCEIVER
from openvima.policies.gato.published import ADAPTER as GATO
from openvima.policies.gpt.published import ADAPTER as GPT
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.published.rules import PublishedAdapter, to_ours, to_theirs
from openvima.policies.vima.published import ADAPTER as VIMA

PREFIX = "policy."  # before every name in a file
ADAPTERS = {adapter.architecture: adapter for adapter in (VIMA, GATO, FLAMINGO, GPT)}
# Unused position counters, masks and embeddings of the files.
_UNUSED = re.compile(
    r"(xattn_gpt|transformer\.lm)\.(position_ids|xattn_position_ids|h\.\d+\.attn\.bias)"
    r"|xattn_gpt\.xattns\.\d+\.kv_position_ids"
    r"|transformer\.lm\.tokens_embed\.weight"
    r"|t5_prompt_encoder\.t5\.(shared|encoder\.embed_tokens)\.weight"
)


def is_unused(name: str) -> bool:
    """Whether a published name, without prefix, is an unused entry."""
    return _UNUSED.fullmatch(name) is not None


def without_prefix(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Remove the prefix `policy.` from the names of published weights."""
    return {name.removeprefix(PREFIX): tensor for name, tensor in weights.items()}


def adapter_of(weights: Iterable[str]) -> PublishedAdapter:
    """Recognise the architecture of weights by their published names.

    Raises:
        CheckpointError: It is none of the four.
    """
    names = {name.removeprefix(PREFIX) for name in weights}
    if any(name.startswith("obj_encoder.bbox_mlp.") for name in names):
        return VIMA
    if any(name.startswith(f"{PERCEIVER}.") for name in names):
        return FLAMINGO
    if any(name.startswith("transformer.lm.") for name in names):
        return GPT if "obj_encoder.cropped_img_encoder.vit.cls_token" in names else GATO
    raise CheckpointError(
        "these are no weights of VIMA, VIMA-Gato, VIMA-Flamingo or VIMA-GPT: no name begins with "
        f"obj_encoder.bbox_mlp, {PERCEIVER} or transformer.lm."
    )


def from_published(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename published weights to their names in this package.

    Args:
        weights: Weights by published name, with or without the prefix `policy.`.

    Returns:
        Weights in float32, matrices as (out, in). Unused entries are dropped; unknown names are unchanged.

    Raises:
        CheckpointError: The names are not those of VIMA or one of its baselines.
    """
    adapter = adapter_of(weights)
    result = {}
    for name, tensor in without_prefix(weights).items():
        if not is_unused(name):
            ours, transposed = to_ours(adapter.rules, name) or (name, False)
            result[ours] = _converted(tensor, transposed)
    return result


def to_published(network: PolicyNetwork) -> dict[str, torch.Tensor]:
    """Give the weights of a network their published names, without `policy.` before them.

    Numbers of heads are not in the weights; a file gives those of the decoder in its `cfg`, and all image
    encoders have 24.

    Args:
        network: Of the published architecture, in any size, with or without weights.

    Returns:
        Weights in float32, matrices as they are published. They may share memory with the network.

    Raises:
        CheckpointError: The network has parts that no published policy has.
    """
    adapter = ADAPTERS.get(network.config.architecture, VIMA)
    result, without_name = {}, []
    for ours, tensor in network.state_dict().items():
        renamed = to_theirs(adapter.rules, ours)
        if renamed is None:
            without_name.append(ours)
        else:
            name, transposed = renamed
            result[name] = _converted(tensor, transposed)
    if without_name:
        raise CheckpointError(
            f"this network has parts that no published policy has: {', '.join(without_name)}. "
            "Only presets of the form vima-…, gato-…, flamingo-… and gpt-… have published names."
        )
    return result


def _converted(tensor: torch.Tensor, transposed: bool) -> torch.Tensor:
    tensor = tensor.detach()
    tensor = tensor.float() if tensor.is_floating_point() else tensor
    return (tensor.T if transposed and tensor.ndim == 2 else tensor).contiguous()
