"""Prompts and object sets for the heads of the pointer models."""

import torch

from openvima.policies.pointer.correspondence import ObjectFeatures
from openvima.policies.pointer.inputs import ObjectSet, PointerPrompt


def object_set(
    tokens_BKD: torch.Tensor,
    appearance_BKA: torch.Tensor,
    positions_BK2: torch.Tensor,
    rotation_bins: int = 0,
) -> ObjectSet:
    """Objects that all exist, each in an image of its own."""
    batch, count = tokens_BKD.shape[:2]
    return ObjectSet(
        tokens_BKD,
        torch.ones(batch, count, dtype=torch.bool),
        appearance_BKA,
        positions_BK2,
        torch.arange(count).expand(batch, count),
        tokens_BKD.new_zeros(batch, count, rotation_bins),
    )


def pointer_prompt(
    masked_BLD: torch.Tensor, appearance_BLA: torch.Tensor, object_mask_BL: torch.Tensor, objects: ObjectSet
) -> PointerPrompt:
    """An encoded prompt whose heads-only parts are given; no word describes anything."""
    batch, length, width = masked_BLD.shape[0], masked_BLD.shape[1], appearance_BLA.shape[-1]
    none = ObjectFeatures(
        masked_BLD.new_zeros(batch, 2, 0, 1),
        torch.zeros(batch, 2, 0, 4, dtype=torch.int64),
        torch.zeros(batch, 2, 0, dtype=torch.bool),
        masked_BLD.new_zeros(batch, 0, width),
        masked_BLD.new_zeros(batch, 0, 2),
        torch.zeros(batch, 0, dtype=torch.bool),
        torch.zeros(batch, 0, dtype=torch.int64),
    )
    return PointerPrompt(
        masked_BLD,
        masked_BLD,
        torch.ones(batch, length, dtype=torch.bool),
        object_mask_BL,
        appearance_BLA,
        torch.zeros_like(appearance_BLA),
        none,
        objects,
    )
