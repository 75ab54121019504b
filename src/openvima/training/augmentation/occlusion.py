"""Gaps in objects: what shows through a grating is white in a prompt image and the table in a scene.

Few shapes of the training partition have gaps, so that what shines through them would be taken for their
texture. Here bars of the ground are painted over crops at random, over the prompt image and the scenes of one
object alike.

Shape suffixes: K objects, V views, Y rows, X columns of a crop.
"""

import math
from dataclasses import replace

import torch

from openvima.render.rasteriser import FLOOR_RGB, SHEET_RGB
from openvima.training.pretrain import Again, Pairs

_BEHIND_PROMPT, _BEHIND_SCENE = FLOOR_RGB[0], SHEET_RGB[0]  # both are gray
_NUM_BARS, _NUM_STAYS = (3, 8), (0, 3)  # bars across a crop, and places at which what stays crosses them
_OPEN = (0.2, 0.6)  # share of the crop's middle that is open
_RIM = (0.03, 0.2)  # from the border of a crop to the gaps
_STAY_WIDTH = 0.08


def with_gaps(pairs: Pairs, share: float, generator: torch.Generator) -> Pairs:
    """Paint gaps over the crops of some objects.

    Turns of these objects are not told any more: gratings look the same from two sides.

    Args:
        pairs: Their crops become float32.
        share: How probable gaps are for each object.
        generator: Draws them.
    """
    count, device = len(pairs.looks), pairs.scene_crops.device
    drawn_KD = torch.rand(count, 6, generator=generator)
    has_gaps_K = drawn_KD[:, 0] < share

    def painted(crops: torch.Tensor, ground: int) -> torch.Tensor:
        crops = crops.float()
        is_open = _gratings(drawn_KD, crops.shape[-1], generator) & has_gaps_K[:, None, None]
        return crops.masked_fill(is_open[:, None, None].to(device), ground)

    again = pairs.again
    if again:
        turns = again.turns.masked_fill(has_gaps_K[:, None].to(device), math.nan)
        again = Again(painted(again.crops, _BEHIND_SCENE), again.masks, turns)
    return replace(
        pairs,
        prompt_crops=painted(pairs.prompt_crops, _BEHIND_PROMPT),
        scene_crops=painted(pairs.scene_crops, _BEHIND_SCENE),
        again=again,
    )


def _gratings(drawn_KD: torch.Tensor, size: int, generator: torch.Generator) -> torch.Tensor:
    """Which pixels of each object are open, (K, Y, X): the same grating along either axis."""
    count = len(drawn_KD)
    across = torch.rand(count, generator=generator)[:, None] < 0.5
    bars, stays, is_open, rim, phase = (drawn_KD[:, number, None] for number in range(1, 6))
    place = (torch.arange(size) + 0.5)[None] / size
    num_bars = _between(bars, _NUM_BARS).round()
    num_stays = _between(stays, _NUM_STAYS).round()
    inside = (place - 0.5).abs() < 0.5 - _between(rim, _RIM)
    is_bar = torch.frac(place * num_bars + phase) < _between(is_open, _OPEN)
    nearest = torch.frac(place * (num_stays + 1) + 0.5) - 0.5  # from the stays, and from both borders
    is_stay = nearest.abs() < _STAY_WIDTH * (num_stays + 1) / 2
    along = is_bar & inside
    beside = inside & ~is_stay
    upright = along[:, None, :] & beside[:, :, None]
    return torch.where(across[..., None], upright.mT, upright)


def _between(share: torch.Tensor, limits: tuple[float, float]) -> torch.Tensor:
    low, high = limits
    return low + (high - low) * share
