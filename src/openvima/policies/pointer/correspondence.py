"""Attention between the objects of two images: what changed, and what differs from the most similar object.

A single object carries little information where a prompt shows changes: which object moved between frames, by
how far one was rotated, which of two similar ones is taller. Each object attends to the most similar object
of another set, and the difference is added to its token.

Shape suffixes: V views, N objects, M objects they attend to, H heads, F width of crop features, A width of
appearance, D width of an object token, R bins of rotations; `...` any axes, such as batch and steps.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.nn.layers import TensorRecord, mlp
from openvima.policies.nn.object_encoder import NUM_VIEWS, ObjectEncoderConfig
from openvima.policies.pointer.config import CorrespondenceConfig

_UNIT_M = 0.1  # positions are compared in decimetres, so that differences are of the order of 1
_SAME_PLACE_M = 0.03  # scale of the "same place" feature
_MAX_DISTANCE = 5.0  # units; larger distances are clipped
_BOX_UNIT_PX = 32.0  # sides of boxes are of this order
_MAX_AGE = 8.0  # images; older ones are clipped to this age

# As `ObjectEncoder.rotation_between`.
RotationBetween = Callable[[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


@dataclass(frozen=True, slots=True, eq=False)
class ObjectFeatures(TensorRecord):
    """Appearance and position of a set of objects.

    Args:
        features_VNF: Crop features, shape (..., 2, N, F).
        boxes_VN4: Boxes in pixels, shape (..., 2, N, 4), integers.
        masks_VN: Whether the object is visible in the view, shape (..., 2, N). One that is visible in none
            does not exist.
        appearance_NA: Appearance embeddings of length 1, shape (..., N, A).
        positions_N2: Table points under the boxes, metres, shape (..., N, 2); in float32 at least.
        in_scene_N: Whether the image shows a scene, where the object has a position, shape (..., N).
        image_index_N: Index of the image in temporal order, shape (..., N), integers.
    """

    features_VNF: torch.Tensor
    boxes_VN4: torch.Tensor
    masks_VN: torch.Tensor
    appearance_NA: torch.Tensor
    positions_N2: torch.Tensor
    in_scene_N: torch.Tensor
    image_index_N: torch.Tensor

    @property
    def exists_N(self) -> torch.Tensor:
        """Which objects exist, shape (..., N)."""
        return self.masks_VN.any(dim=-2)


class Correspondence(nn.Module):
    """Attends from each object to the most similar one of another set, and returns the difference.

    Two images of a prompt, the first two objects in the first image: objects 3 and 4 attend to 1 and 2, and
    if 4 resembles 2, its features say how 4 differs from 2, such as where it moved.

        image 0: [1, 2]    image 1: [3, 4]

    Heads differ in their biases towards near objects and recent images, which separates several images of one
    object. Attention has a sink: a head may find nothing, which gives features of zero. Of the crops only the
    difference is returned; the tokens, to which the result is added, encode the crops themselves.

    Args:
        config: Sizes.
        images: Sizes of the object encoder, whose tokens the result is added to.
    """

    def __init__(self, config: CorrespondenceConfig, images: ObjectEncoderConfig) -> None:
        super().__init__()
        heads = config.num_heads
        self.crop_dropout, self.rotation_bins = images.crop_dropout, images.rotation_bins
        # Fresh heads prefer the latest image, the earliest one, neither, and so on.
        preferences = [(2.0, -2.0, 0.0)[head % 3] for head in range(heads)]
        self.logit_scale = nn.Parameter(torch.full((heads,), 20.0))
        self.threshold = nn.Parameter(torch.full((heads,), 0.5))  # similarity below which nothing is found
        self.distance_bias = nn.Parameter(torch.zeros(heads))
        self.recency_bias = nn.Parameter(torch.tensor(preferences))
        per_head = NUM_VIEWS * (images.crop.output_width + 4) + 6
        widths = (heads * per_head + images.rotation_bins, config.hidden_width, images.width)
        # At initialisation tokens are nearly what they are without correspondence.
        self.difference = mlp(widths, last_gain=0.3)

    def forward(
        self,
        own: ObjectFeatures,
        other: ObjectFeatures,
        allowed_NM: torch.Tensor,
        rotation_between: RotationBetween,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Compare objects.

        Args:
            own: The objects.
            other: What they attend to; its axes before the objects may have length 1.
            allowed_NM: Which of them each object may attend to, shape (..., N, M).
            rotation_between: Estimates rotations; unused if the object encoder has no bins of them.

        Returns:
            The change of the objects' tokens, shape (..., N, D); and the probabilities of the rotation from
            what the first head attends to, (..., N, R), zero where it finds nothing. R is 0 without
            estimates.
        """
        dtype = own.features_VNF.dtype
        in_scenes_NM = own.in_scene_N[..., :, None] & other.in_scene_N[..., None, :]
        # Differences fit any precision; the positions themselves need all digits.
        moved_NM2 = (own.positions_N2[..., :, None, :] - other.positions_N2[..., None, :, :]) / _UNIT_M
        moved_NM2 = moved_NM2.to(dtype) * in_scenes_NM[..., None]
        squared_NM = moved_NM2.square().sum(-1).add(1e-12)
        similarity_NM = own.appearance_NA @ other.appearance_NA.mT
        age_NM = (own.image_index_N[..., :, None] - other.image_index_N[..., None, :]).clamp(max=_MAX_AGE)
        weights_HNM = self._weights(
            similarity_NM,
            squared_NM.sqrt().clamp(max=_MAX_DISTANCE),
            age_NM.to(dtype),
            allowed_NM & other.exists_N[..., None, :] & own.exists_N[..., :, None],
        )
        in_scenes_NM = in_scenes_NM.to(dtype)
        near_NM = torch.exp(squared_NM * -((_UNIT_M / _SAME_PLACE_M) ** 2)) * in_scenes_NM
        pairs_NMX = torch.cat(
            [
                torch.stack([torch.ones_like(near_NM), similarity_NM, in_scenes_NM, near_NM], dim=-1),
                moved_NM2.clamp(-_MAX_DISTANCE, _MAX_DISTANCE),
            ],
            dim=-1,
        )
        # What is attended to counts as a pair: its first number is how much was found at all, and the rest of
        # 1, that of the sink, leaves zeros. Differences of crops are taken view by view, in those that show
        # both.
        attended_HNX = torch.einsum("...hnm,...nmx->...hnx", weights_HNM, pairs_NMX)
        differ_HVNX, target_VNF, found_HVN1 = self._in_views(own, other, weights_HNM)
        views = differ_HVNX.flatten(-4, -3).unbind(-3)  # (..., N, X) each
        parts = []
        for head, attended_NX in enumerate(attended_HNX.unbind(-3)):
            parts += [attended_NX, *views[NUM_VIEWS * head : NUM_VIEWS * (head + 1)]]
        if not self.rotation_bins:
            return self.difference(torch.cat(parts, dim=-1)), attended_HNX[..., 0, :, :0]
        rotations_NR = self._rotations(own, target_VNF, found_HVN1[..., 0, :, :, 0], rotation_between)
        return self.difference(torch.cat([*parts, rotations_NR], dim=-1)), rotations_NR

    def _weights(
        self,
        similarity_NM: torch.Tensor,
        distance_NM: torch.Tensor,
        age_NM: torch.Tensor,
        allowed_NM: torch.Tensor,
    ) -> torch.Tensor:
        """Attention weights, (..., H, N, M); the rest of 1 goes to the sink."""
        logit_scale, threshold, distance_bias, recency_bias = (
            parameter.view(-1, 1, 1)
            for parameter in (
                F.softplus(self.logit_scale),
                self.threshold,
                self.distance_bias,
                self.recency_bias,
            )
        )
        similarity_HNM, allowed_HNM = similarity_NM.unsqueeze(-3), allowed_NM.unsqueeze(-3)
        scores_HNM = logit_scale * similarity_HNM
        scores_HNM = (
            scores_HNM - distance_bias * distance_NM.unsqueeze(-3) - recency_bias * age_NM.unsqueeze(-3)
        )
        scores_HNM = torch.where(allowed_HNM, scores_HNM, torch.finfo(scores_HNM.dtype).min)
        weights_HNM = torch.softmax(scores_HNM, dim=-1) * allowed_HNM
        # Whether anything is found depends on similarity alone; the biases only break ties.
        found_HN1 = (weights_HNM * similarity_HNM).sum(-1, keepdim=True) - threshold
        return weights_HNM * torch.sigmoid(logit_scale * found_HN1)

    def _in_views(
        self, own: ObjectFeatures, other: ObjectFeatures, weights_HNM: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Compare crops and boxes in views that show both.

        Returns:
            Differences of crop features and of boxes, (..., H, V, N, F + 4); crop features of what the first
            head attends to, (..., V, N, F); and the total attention weights, (..., H, V, N, 1).
        """
        own_VNX = _crops_and_boxes(own)
        other_VMX = own_VNX if other is own else _crops_and_boxes(other)
        shown_VNM = own.masks_VN[..., :, None] & other.masks_VN[..., None, :]
        weights_HVNM = weights_HNM.unsqueeze(-3) * shown_VNM.unsqueeze(-4)  # zero in views that lack one
        # Negating the smaller tensor saves a copy of the larger one.
        negative_HVNX = torch.einsum("...hvnm,...vmx->...hvnx", -weights_HVNM, other_VMX)
        found_HVN1 = weights_HVNM.sum(-1, keepdim=True)
        differ_HVNX = torch.addcmul(negative_HVNX, own_VNX.unsqueeze(-4), found_HVN1)
        width = own.features_VNF.shape[-1]
        if self.training and self.crop_dropout:
            shape = (*differ_HVNX.shape[:-4], 1, 1, differ_HVNX.shape[-2], 1)
            kept_N1 = torch.rand(shape, device=differ_HVNX.device) >= self.crop_dropout
            crops = torch.arange(differ_HVNX.shape[-1], device=differ_HVNX.device) < width
            differ_HVNX = differ_HVNX * (kept_N1 | ~crops)
        return differ_HVNX, -negative_HVNX[..., 0, :, :, :width], found_HVN1

    def _rotations(
        self,
        own: ObjectFeatures,
        target_VNF: torch.Tensor,
        found_VN: torch.Tensor,
        rotation_between: RotationBetween,
    ) -> torch.Tensor:
        """Probabilities of the rotations from what one head attends to, (..., N, R)."""
        is_found_VN = found_VN > 0.5
        if not (self.training or is_found_VN.any()):  # as most often in a view
            return found_VN.new_zeros(*found_VN.shape[:-2], found_VN.shape[-1], self.rotation_bins)
        # Attention is nearly always on one object, so the mean stands for its features.
        target_VNF = target_VNF / found_VN[..., None].clamp(min=1e-4)
        probabilities_NR = rotation_between(target_VNF, own.features_VNF, is_found_VN, own.masks_VN)
        return probabilities_NR * is_found_VN.any(dim=-2)[..., None]


def _crops_and_boxes(objects: ObjectFeatures) -> torch.Tensor:
    """Crop features and boxes, (..., V, N, F + 4)."""
    boxes_VN4 = objects.boxes_VN4.to(objects.features_VNF.dtype) / _BOX_UNIT_PX
    return torch.cat([objects.features_VNF, boxes_VN4], dim=-1)


def in_earlier_image(objects: ObjectFeatures, other: ObjectFeatures) -> torch.Tensor:
    """Which objects of another set are in an earlier image, (..., N, M)."""
    return other.image_index_N[..., None, :] < objects.image_index_N[..., :, None]
