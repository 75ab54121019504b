"""Horizontal flips of contrastive pairs."""

from dataclasses import replace

import torch

from openvima.training.pretraining.pairs import Pairs, SecondView


def with_horizontal_flips(pairs: Pairs, generator: torch.Generator) -> Pairs:
    """Mirror all images of half of the objects, drawn at random, and reverse their rotations.

    Both cameras look at the table from its middle, so that mirrored images are images of mirrored objects.
    """
    view = pairs.second_view
    assert view is not None, "only pairs with a second view are flipped"
    is_flipped = (torch.rand(len(pairs.scenes), generator=generator) < 0.5).to(pairs.scenes.device)

    def flipped(crops: torch.Tensor) -> torch.Tensor:
        return torch.where(is_flipped[:, None, None, None, None], crops.flip(-1), crops)

    rotations = torch.where(is_flipped[:, None], -view.rotations, view.rotations)
    return replace(
        pairs,
        prompt_crops=flipped(pairs.prompt_crops),
        scene_crops=flipped(pairs.scene_crops),
        second_view=SecondView(flipped(view.crops), view.masks, rotations),
    )
