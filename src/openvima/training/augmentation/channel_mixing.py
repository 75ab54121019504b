"""Colour augmentation of contrastive pretraining, the same for all crops of a batch."""

import torch


def channel_mixing(generator: torch.Generator) -> torch.Tensor:
    """Draw a (3, 3) matrix that mixes R, G and B: half of the time the identity, else a blended permutation.

    Rows sum to 1, so that white, grey and black stay what they are.
    """
    if torch.rand((), generator=generator) < 0.5:
        return torch.eye(3)
    permutation = torch.eye(3)[torch.randperm(3, generator=generator)]
    blending = torch.rand(3, 3, generator=generator)
    weight = 0.5 * torch.rand((), generator=generator)
    return (1 - weight) * permutation + weight * blending / blending.sum(1, keepdim=True)
