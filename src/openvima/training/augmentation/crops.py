"""Augmentation of the crops of contrastive pretraining.

Shape suffixes: K objects, D draws, Y rows, X columns of a crop.
"""

import math
from dataclasses import replace

import torch
from torch.nn import functional as F

from openvima.render.rasteriser import FLOOR_RGB, SHEET_RGB
from openvima.training.pretraining.pairs import SECOND_VIEW, Pairs


def with_horizontal_flips(pairs: Pairs, generator: torch.Generator) -> Pairs:
    """Mirror all images of half of the objects, drawn at random, and reverse their rotations.

    Both cameras look at the table from its middle, so that mirrored images are images of mirrored objects.
    """
    assert pairs.rotations is not None, "only pairs with a second view are flipped"
    is_flipped = (torch.rand(len(pairs.scenes), generator=generator) < 0.5).to(pairs.scenes.device)
    return replace(
        pairs,
        crops=torch.where(is_flipped.view(-1, 1, 1, 1, 1, 1), pairs.crops.flip(-1), pairs.crops),
        rotations=torch.where(is_flipped[:, None], -pairs.rotations, pairs.rotations),
    )


_BACKGROUNDS = (FLOOR_RGB[0], SHEET_RGB[0], SHEET_RGB[0])  # of each image; all are gray
_NUM_BARS, _NUM_BRACES = (3, 8), (0, 3)  # bars across a crop, and visible strips that cross them
_BAR_WIDTH = (0.2, 0.6)  # fraction of the distance between bars
_MARGIN = (0.03, 0.2)  # from the border of a crop to the bars
_BRACE_WIDTH = 0.08


def with_occlusion(pairs: Pairs, prob: float, generator: torch.Generator) -> Pairs:
    """Paint bars of the background over the crops of some objects.

    The background is white in a prompt image, the table in a scene. Few shapes of the training partition have
    gaps, so that the encoder would take what shows through those of pallets and crates for their texture. All
    images of one object get the same bars, upright or level.

    Their rotations become NaN: bars look the same from two sides.

    Args:
        pairs: Their crops become float32.
        prob: Probability for each object.
        generator: Source of the draws.
    """
    device, rotations = pairs.crops.device, pairs.rotations
    drawn_KD = torch.rand(len(pairs.scenes), 6, generator=generator)
    is_chosen_K = drawn_KD[:, 0] < prob
    images = list(pairs.crops.float().unbind(1))
    for number in (*range(SECOND_VIEW, len(images)), 0, 1):  # the order of the draws
        is_occluded = _bars(drawn_KD, images[number].shape[-1], generator) & is_chosen_K[:, None, None]
        is_occluded = is_occluded[:, None, None].to(device)
        images[number] = images[number].masked_fill(is_occluded, _BACKGROUNDS[number])
    if rotations is not None:
        rotations = rotations.masked_fill(is_chosen_K[:, None].to(device), math.nan)
    return replace(pairs, crops=torch.stack(images, dim=1), rotations=rotations)


def _bars(drawn_KD: torch.Tensor, size: int, generator: torch.Generator) -> torch.Tensor:
    """Return which pixels of each object are occluded, (K, Y, X), bool."""
    count = len(drawn_KD)
    is_upright = torch.rand(count, generator=generator)[:, None] < 0.5
    bars, braces, width, margin, phase = (drawn_KD[:, column, None] for column in range(1, 6))
    position = (torch.arange(size) + 0.5)[None] / size
    num_bars = _between(bars, _NUM_BARS).round()
    num_braces = _between(braces, _NUM_BRACES).round()
    is_inside = (position - 0.5).abs() < 0.5 - _between(margin, _MARGIN)
    is_bar = torch.frac(position * num_bars + phase) < _between(width, _BAR_WIDTH)
    distance = torch.frac(position * (num_braces + 1) + 0.5) - 0.5  # to the braces, and to both borders
    is_brace = distance.abs() < _BRACE_WIDTH * (num_braces + 1) / 2
    along = is_bar & is_inside
    across = is_inside & ~is_brace
    bars_KYX = along[:, None, :] & across[:, :, None]
    return torch.where(is_upright[..., None], bars_KYX.mT, bars_KYX)


def _between(fraction: torch.Tensor, limits: tuple[float, float]) -> torch.Tensor:
    low, high = limits
    return low + (high - low) * fraction


_CROP_PX = 32


def with_box_jitter(pairs: Pairs, pixels: float, generator: torch.Generator) -> Pairs:
    """Shift and scale each crop at random.

    Args:
        pairs: Their crops become float32.
        pixels: Largest shift of a crop, and half of the largest change of its size, in its own pixels.
        generator: Source of the draws.
    """
    by_image = pairs.crops.transpose(0, 1)  # the order of the draws
    flat = by_image.flatten(0, 2).float()
    draws = (2 * torch.rand(len(flat), 3, generator=generator) - 1).to(flat.device)
    draws *= 2 * pixels / _CROP_PX  # the borders are at −1 and 1
    theta = flat.new_zeros(len(flat), 2, 3)
    theta[:, 0, 0] = theta[:, 1, 1] = 1 + draws[:, 0]
    theta[:, :, 2] = draws[:, 1:]
    grid = F.affine_grid(theta, list(flat.shape), align_corners=False)
    sampled = F.grid_sample(flat, grid, padding_mode="border", align_corners=False)
    return replace(pairs, crops=sampled.unflatten(0, by_image.shape[:3]).transpose(0, 1))


def draw_channel_mixing(generator: torch.Generator) -> torch.Tensor:
    """Draw a (3, 3) matrix that mixes R, G and B: half of the time the identity, else a blended permutation.

    Rows sum to 1, so that white, grey and black stay what they are.
    """
    if torch.rand((), generator=generator) < 0.5:
        return torch.eye(3)
    permutation = torch.eye(3)[torch.randperm(3, generator=generator)]
    blending = torch.rand(3, 3, generator=generator)
    weight = 0.5 * torch.rand((), generator=generator)
    return (1 - weight) * permutation + weight * blending / blending.sum(1, keepdim=True)
