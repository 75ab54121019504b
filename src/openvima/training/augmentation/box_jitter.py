"""Box jitter: crops are shifted and scaled a little, as detected boxes are."""

from dataclasses import replace

import torch
from torch.nn import functional as F

from openvima.training.pretraining.pairs import Pairs

_CROP_PX = 32


def with_box_jitter(pairs: Pairs, pixels: float, generator: torch.Generator) -> Pairs:
    """Shift and scale each crop at random.

    Args:
        pairs: Their crops become float32.
        pixels: Largest shift of a crop, and half of the largest change of its size, in its own pixels.
        generator: Source of the draws.
    """
    view = pairs.second_view
    return replace(
        pairs,
        prompt_crops=_jittered(pairs.prompt_crops, pixels, generator),
        scene_crops=_jittered(pairs.scene_crops, pixels, generator),
        second_view=replace(view, crops=_jittered(view.crops, pixels, generator)) if view else None,
    )


def _jittered(crops: torch.Tensor, pixels: float, generator: torch.Generator) -> torch.Tensor:
    flat = crops.flatten(0, -4).float()
    draws = (2 * torch.rand(len(flat), 3, generator=generator) - 1).to(flat.device)
    draws *= 2 * pixels / _CROP_PX  # the borders are at −1 and 1
    theta = flat.new_zeros(len(flat), 2, 3)
    theta[:, 0, 0] = theta[:, 1, 1] = 1 + draws[:, 0]
    theta[:, :, 2] = draws[:, 1:]
    grid = F.affine_grid(theta, list(flat.shape), align_corners=False)
    sampled = F.grid_sample(flat, grid, padding_mode="border", align_corners=False)
    return sampled.unflatten(0, crops.shape[:-3])
