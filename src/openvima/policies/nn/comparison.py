"""Comparisons: what became of an object, or how it differs from the one that looks most like it.

An object alone says little where a prompt shows changes: which object moved from picture to picture, by how
much one was turned, which of two twins is the taller one. A comparison looks for the object of another set
that looks most like it, and tells the difference.

Shape suffixes: V views, N objects, M objects to compare them with, H looks, F width of crop features, A width
of appearance, D width of an object token, R bins of turns; `...` any axes, such as batch and steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.errors import ConfigError
from openvima.policies.nn.mlp import mlp, scale_last
from openvima.policies.nn.object_encoder import NUM_VIEWS, ObjectEncoderConfig

_UNIT_M = 0.1  # positions are compared in decimetres, so that differences are of the order of 1
_HERE_M = 0.03  # an object that is so near counts as being in the same place, more or less
_FAR = 5.0  # units; what is farther away is not less near than this
_BOX_UNIT_PX = 32.0  # sides of boxes are of this order
_MOST_IMAGES = 8.0  # images that lie farther back count as this far

# As `ObjectEncoder.turn_between`.
TurnBetween = Callable[[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


@dataclass(frozen=True, slots=True)
class ComparisonConfig:
    """Sizes of the comparisons.

    Args:
        hidden_width: Width of the hidden layer that reads the differences.
        num_looks: Objects that each object is compared with, such as the latest and the earliest alike one.
    """

    hidden_width: int = 192
    num_looks: int = 2

    def __post_init__(self) -> None:
        if self.hidden_width < 1 or self.num_looks < 1:
            raise ConfigError(
                f"comparison: hidden_width is {self.hidden_width} and num_looks {self.num_looks}; both must "
                "be at least 1."
            )


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """What is known of the looks and the places of some objects.

    Args:
        features_VNF: Crop features, shape (..., 2, N, F).
        boxes_VN4: Boxes in pixels, shape (..., 2, N, 4), integers.
        masks_VN: Whether the object is visible in the view, shape (..., 2, N). One that is visible in none
            does not exist.
        appearance_NA: Appearance, vectors of length 1, shape (..., N, A).
        positions_N2: Table points under the boxes, metres, shape (..., N, 2); in float32 at least.
        on_table_N: Whether the object lies there, instead of being shown alone, shape (..., N).
        numbers_N: Number of the image that shows it, in the order of time, shape (..., N), integers.
    """

    features_VNF: torch.Tensor
    boxes_VN4: torch.Tensor
    masks_VN: torch.Tensor
    appearance_NA: torch.Tensor
    positions_N2: torch.Tensor
    on_table_N: torch.Tensor
    numbers_N: torch.Tensor

    def _tensors(self) -> tuple[torch.Tensor, ...]:
        return tuple(getattr(self, name) for name in Sights.__slots__)

    def select(self, rows: Sequence[int]) -> "Sights":
        """Return those of some rows of the batch, the first axis."""
        index = torch.as_tensor(rows, dtype=torch.int64, device=self.masks_VN.device)
        return Sights(*(tensor[index] for tensor in self._tensors()))

    def at_each_step(self) -> "Sights":
        """Return the same with an axis of length 1 after the batch, to be compared with every step."""
        return Sights(*(tensor.unsqueeze(1) for tensor in self._tensors()))

    def at_step(self, step: int) -> "Sights":
        """Return those of one step, the second axis."""
        return Sights(*(tensor[:, step] for tensor in self._tensors()))


class Comparison(nn.Module):
    """Looks at the object of another set that looks most like each object, and tells the difference.

    Two pictures of a prompt, the first two objects in the first of them: objects 3 and 4 are compared with 1
    and 2, and since 4 looks like 2 its features say how 4 differs from 2, such as where it has gone.

        image 0: [1, 2]    image 1: [3, 4]

    Looks differ in what counts besides appearance: how near the other object is, and how late its image. That
    tells the pictures of one object apart. A look may also find nothing, which gives features of zero. Of the
    crops only the difference is told: the tokens, to which the result is added, know the crops themselves.

    Args:
        config: Sizes.
        images: Sizes of the object encoder, whose tokens the result is added to.
    """

    def __init__(self, config: ComparisonConfig, images: ObjectEncoderConfig) -> None:
        super().__init__()
        looks = config.num_looks
        self.crop_dropout = images.crop_dropout
        # Fresh looks prefer the latest image, the earliest one, neither, and so on; that parts them.
        preferences = [(2.0, -2.0, 0.0)[look % 3] for look in range(looks)]
        self.sharpness = nn.Parameter(torch.full((looks,), 20.0))
        self.threshold = nn.Parameter(torch.full((looks,), 0.5))  # least likeness of what is found
        self.nearness = nn.Parameter(torch.zeros(looks))
        self.lateness = nn.Parameter(torch.tensor(preferences))
        per_look = NUM_VIEWS * (images.crop.output_width + 4) + 6
        widths = (looks * per_look + images.turn_bins, config.hidden_width, images.width)
        # Tokens are to begin with nearly what they are without comparisons.
        self.difference = scale_last(mlp(widths), gain=0.3)

    def forward(
        self,
        own: Sights,
        other: Sights,
        allowed_NM: torch.Tensor,
        turn_between: TurnBetween | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Compare.

        Args:
            own: The objects.
            other: What they may be compared with; its axes before the objects may have length 1.
            allowed_NM: Which of them each object may be compared with, shape (..., N, M).
            turn_between: Estimates turns, where the object encoder can.

        Returns:
            What to add to the tokens of the objects, shape (..., N, D); and the chances of the turns from
            what the first look is at to the object itself, (..., N, R), zero where it is at nothing.
        """
        dtype = own.features_VNF.dtype
        lying_NM = own.on_table_N[..., :, None] & other.on_table_N[..., None, :]
        # Differences of places and of images are small; the places themselves need all digits.
        moved_NM2 = (own.positions_N2[..., :, None, :] - other.positions_N2[..., None, :, :]) / _UNIT_M
        moved_NM2 = moved_NM2.to(dtype) * lying_NM[..., None]
        distance_NM = moved_NM2.square().sum(-1).add(1e-12).sqrt()
        likeness_NM = own.appearance_NA @ other.appearance_NA.mT
        later_NM = (own.numbers_N[..., :, None] - other.numbers_N[..., None, :]).clamp(max=_MOST_IMAGES)
        weights_HNM = self._weights(
            likeness_NM,
            distance_NM.clamp(max=_FAR),
            later_NM.to(dtype),
            allowed_NM & _exists(other)[..., None, :] & _exists(own)[..., :, None],
        )
        lying_NM = lying_NM.to(dtype)
        near_NM = torch.exp(-(distance_NM * (_UNIT_M / _HERE_M)).square()) * lying_NM
        pairs_NMX = torch.cat(
            [
                torch.stack([torch.ones_like(near_NM), likeness_NM, lying_NM, near_NM], dim=-1),
                moved_NM2.clamp(-_FAR, _FAR),
            ],
            dim=-1,
        )
        told_HNX = torch.einsum("...hnm,...nmx->...hnx", weights_HNM, pairs_NMX)
        differ_HVNX, seen_VNF, found_HVN1 = self._in_views(own, other, weights_HNM)
        views = differ_HVNX.flatten(-4, -3).unbind(-3)  # (..., N, X) each
        parts = []
        for look, told_NX in enumerate(told_HNX.unbind(-3)):
            parts += [told_NX, *views[NUM_VIEWS * look : NUM_VIEWS * (look + 1)]]
        if turn_between is None:
            return self.difference(torch.cat(parts, dim=-1)), None
        turns_NR = _turns(own, seen_VNF, found_HVN1[..., 0, :, :, 0], turn_between)
        return self.difference(torch.cat([*parts, turns_NR], dim=-1)), turns_NR

    def _weights(
        self,
        likeness_NM: torch.Tensor,
        distance_NM: torch.Tensor,
        later_NM: torch.Tensor,
        allowed_NM: torch.Tensor,
    ) -> torch.Tensor:
        """How much each look is at each of the other objects, (..., H, N, M); the rest of 1 is at none."""
        sharpness, threshold, nearness, lateness = (
            parameter[:, None, None]
            for parameter in (F.softplus(self.sharpness), self.threshold, self.nearness, self.lateness)
        )
        likeness_HNM, allowed_HNM = likeness_NM.unsqueeze(-3), allowed_NM.unsqueeze(-3)
        scores_HNM = sharpness * likeness_HNM
        scores_HNM = scores_HNM - nearness * distance_NM.unsqueeze(-3) - lateness * later_NM.unsqueeze(-3)
        scores_HNM = scores_HNM.masked_fill(~allowed_HNM, torch.finfo(scores_HNM.dtype).min)
        weights_HNM = torch.softmax(scores_HNM, dim=-1) * allowed_HNM
        # Whether anything is found must not depend on how near or late it is: these part equals alone.
        found_HN1 = (weights_HNM * likeness_HNM).sum(-1, keepdim=True) - threshold
        return weights_HNM * torch.sigmoid(sharpness * found_HN1)

    def _in_views(
        self, own: Sights, other: Sights, weights_HNM: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Compare crops and boxes in views that show both.

        Returns:
            Differences of crop features and of boxes, (..., H, V, N, F + 4); crop features of what the first
            look is at, (..., V, N, F); and how much looks are at something, (..., H, V, N, 1).
        """
        own_VNX, other_VMX = _crops_and_boxes(own), _crops_and_boxes(other)
        weights_HVNM = _in_both(own, other, weights_HNM)
        # The sign goes to the smaller tensor; a difference would cost another copy of the larger one.
        unseen_HVNX = torch.einsum("...hvnm,...vmx->...hvnx", -weights_HVNM, other_VMX)
        found_HVN1 = weights_HVNM.sum(-1, keepdim=True)
        differ_HVNX = torch.addcmul(unseen_HVNX, own_VNX.unsqueeze(-4), found_HVN1)
        width = own.features_VNF.shape[-1]
        if self.training and self.crop_dropout:
            shape = (*differ_HVNX.shape[:-4], 1, 1, differ_HVNX.shape[-2], 1)
            kept_N1 = torch.rand(shape, device=differ_HVNX.device) >= self.crop_dropout
            crops = torch.arange(differ_HVNX.shape[-1], device=differ_HVNX.device) < width
            differ_HVNX = differ_HVNX * (kept_N1 | ~crops)
        return differ_HVNX, -unseen_HVNX[..., 0, :, :, :width], found_HVN1


def _crops_and_boxes(sights: Sights) -> torch.Tensor:
    """Crop features and boxes, (..., V, N, F + 4)."""
    boxes_VN4 = sights.boxes_VN4.to(sights.features_VNF.dtype) / _BOX_UNIT_PX
    return torch.cat([sights.features_VNF, boxes_VN4], dim=-1)


def _in_both(own: Sights, other: Sights, weights_HNM: torch.Tensor) -> torch.Tensor:
    """Weights of looks, zero in views that do not show both, (..., H, V, N, M)."""
    shown_VNM = own.masks_VN[..., :, None] & other.masks_VN[..., None, :]
    return weights_HNM.unsqueeze(-3) * shown_VNM.unsqueeze(-4)


def _turns(
    own: Sights, seen_VNF: torch.Tensor, found_VN: torch.Tensor, turn_between: TurnBetween
) -> torch.Tensor:
    """Chances of the turns since one look, (..., N, R)."""
    # A look is nearly always at one object, so that what it sees stands for that one's features.
    seen_VNF = seen_VNF / found_VN[..., None].clamp(min=1e-4)
    is_found_VN = found_VN > 0.5
    chances_NR = turn_between(seen_VNF, own.features_VNF, is_found_VN, own.masks_VN)
    return chances_NR * is_found_VN.any(dim=-2)[..., None]


def earlier(sights: Sights, other: Sights | None = None) -> torch.Tensor:
    """Which objects of the same or another set are shown by earlier images, (..., N, M)."""
    other = other or sights
    return other.numbers_N[..., None, :] < sights.numbers_N[..., :, None]


def alike_shown(sights: Sights) -> torch.Tensor:
    """Which objects are shown as each one is, on the table or alone, shape (..., N, N)."""
    return sights.on_table_N[..., None, :] == sights.on_table_N[..., :, None]


def others(sights: Sights) -> torch.Tensor:
    """Which objects are other ones than each, shape (N, N)."""
    count = sights.numbers_N.shape[-1]
    return ~torch.eye(count, dtype=torch.bool, device=sights.numbers_N.device)


def _exists(sights: Sights) -> torch.Tensor:
    return sights.masks_VN.any(dim=-2)
