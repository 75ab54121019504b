"""Occlusion by bars of the background: white in a prompt image, the table in a scene.

Few shapes of the training partition have gaps, so that the encoder would take what shows through those of
pallets and crates for their texture. All images of one object get the same bars,
each upright or level at random.

Shape suffixes: K objects, D draws, Y rows, X columns of a crop.
"""

import math
from dataclasses import replace

import torch

from openvima.render.rasteriser import FLOOR_RGB, SHEET_RGB
from openvima.training.pretraining.pairs import Pairs, SecondView

_PROMPT_BACKGROUND, _SCENE_BACKGROUND = FLOOR_RGB[0], SHEET_RGB[0]  # both are gray
_NUM_BARS, _NUM_BRACES = (3, 8), (0, 3)  # bars across a crop, and visible strips that cross them
_BAR_WIDTH = (0.2, 0.6)  # fraction of the distance between bars
_MARGIN = (0.03, 0.2)  # from the border of a crop to the bars
_BRACE_WIDTH = 0.08


def with_occlusion(pairs: Pairs, prob: float, generator: torch.Generator) -> Pairs:
    """Paint bars of the background over the crops of some objects.

    Their rotations become NaN: bars look the same from two sides.

    Args:
        pairs: Their crops become float32.
        prob: Probability for each object.
        generator: Source of the draws.
    """
    count, device = len(pairs.scenes), pairs.scene_crops.device
    drawn_KD = torch.rand(count, 6, generator=generator)
    is_chosen_K = drawn_KD[:, 0] < prob

    def occluded(crops: torch.Tensor, background: int) -> torch.Tensor:
        crops = crops.float()
        is_occluded = _bars(drawn_KD, crops.shape[-1], generator) & is_chosen_K[:, None, None]
        return crops.masked_fill(is_occluded[:, None, None].to(device), background)

    view = pairs.second_view
    if view:
        rotations = view.rotations.masked_fill(is_chosen_K[:, None].to(device), math.nan)
        view = SecondView(occluded(view.crops, _SCENE_BACKGROUND), view.masks, rotations)
    return replace(
        pairs,
        prompt_crops=occluded(pairs.prompt_crops, _PROMPT_BACKGROUND),
        scene_crops=occluded(pairs.scene_crops, _SCENE_BACKGROUND),
        second_view=view,
    )


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
