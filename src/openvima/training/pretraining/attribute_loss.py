"""The supervised contrastive loss of attributes and captions, and how often the most similar object is alike.

Shape suffixes: K objects, M and N images of objects, V views, F features, P attributes, W width of a
projection.
"""

import math
from collections.abc import Sequence

import torch
from torch.nn import functional as F

from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.policies.pointer.config import ATTRIBUTES
from openvima.policies.pointer.words import Attributes
from openvima.policies.tokenizer import PADDING_ID
from openvima.training.pretraining.attribute_labels import AttributeLabels
from openvima.training.pretraining.captions import Captions
from openvima.training.pretraining.pairs import Pairs

# Intersection of colour histograms, and ratio of lengths: alike from or up to the first, different beyond the
# second. In between nothing is learned: a red and blue stripe is neither like red nor unlike it.
_COLOUR_LIMITS = (0.7, 0.4)
_LENGTH_LIMITS = (1.12, 1.3)
_PROMPT, _SCENE = 0, 1  # images that are labelled; those of the second view are as in the scene


def attribute_loss(
    attributes: Attributes,
    features_3VKF: torch.Tensor,
    masks_3VK: torch.Tensor,
    labels: AttributeLabels,
    *,
    temperature: float,
) -> torch.Tensor:
    """Supervised contrastive loss, mean over attributes.

    Each positive competes with all negatives of its anchor, and not with other positives. Objects that are
    neither alike nor different do not count.

    Args:
        attributes: Gets the gradient, as the features do.
        features_3VKF: Crop features in the prompt image, the scene, and the second view.
        masks_3VK: Whether the object is visible there, shape (3, 2, K).
        labels: Of the objects.
        temperature: Softmax temperature.

    Source: SupCon (Khosla et al. 2020), its loss "out", with one positive at a time in the denominator.
    """
    projected_3KPW = attributes(features_3VKF, labels.boxes.permute(1, 2, 0, 3), masks_3VK)
    projected_PMW = projected_3KPW.flatten(0, 1).transpose(0, 1)
    images = _images(labels, (_PROMPT, _SCENE, _SCENE))
    same_PMM, different_PMM = _compared(images, images)
    is_seen_M = masks_3VK.any(dim=1).flatten()
    is_pair_MM = is_seen_M & is_seen_M[:, None]
    different_PMM = different_PMM & is_pair_MM
    same_PMM = same_PMM & is_pair_MM & ~torch.eye(len(is_seen_M), dtype=torch.bool, device=is_seen_M.device)
    scores_PMM = projected_PMW @ projected_PMW.mT / temperature
    lowest = torch.finfo(scores_PMM.dtype).min
    negatives_PM1 = scores_PMM.masked_fill(~different_PMM, lowest).logsumexp(dim=-1, keepdim=True)
    nll_PM = (F.softplus(negatives_PM1 - scores_PMM) * same_PMM).sum(dim=-1)
    count_PM = same_PMM.sum(dim=-1)
    has_both_PM = (count_PM > 0) & different_PMM.any(dim=-1)
    nll_PM = nll_PM / count_PM.clamp(min=1) * has_both_PM
    return (nll_PM.sum(dim=-1) / has_both_PM.sum(dim=-1).clamp(min=1)).mean()


def caption_loss(attributes: Attributes, captions: Captions) -> torch.Tensor:
    """Cross-entropy of the attributes that captions name: those that any of their words does (noisy or)."""
    is_word_BL1 = (captions.word_ids != PADDING_ID)[..., None]
    none_BP = (F.softplus(attributes.word_logits(captions.word_ids)) * is_word_BL1).sum(dim=1)
    return torch.where(captions.targets, -torch.log(-torch.expm1(-none_BP)), none_BP).mean()


@torch.no_grad()
def attribute_accuracy(
    encoder: ObjectEncoder, attributes: Attributes, pairs: Pairs, *, chunk: int = 256
) -> dict[str, float]:
    """How often the most similar other object of the scene is alike, by name of the attribute.

    Only prompt images count for which the scene has another object that is alike and one that differs;
    attributes without any are left out.
    """
    labels = pairs.attributes
    assert labels is not None
    rows = torch.arange(len(pairs.scenes), device=pairs.scenes.device).split(chunk)
    projected = []
    for part in map(pairs.select, rows):
        assert part.attributes is not None
        features = encoder.encode_images(torch.stack([part.prompt_crops, part.scene_crops])).transpose(1, 2)
        masks = torch.stack([part.prompt_masks, part.scene_masks]).transpose(1, 2)
        boxes = part.attributes.boxes[:, : len(masks)].permute(1, 2, 0, 3)
        projected.append(attributes(features, boxes, masks).transpose(1, 2))  # (2, P, K, W)
    prompt_PKW, scene_PKW = torch.cat(projected, dim=2)  # of (2, P, K, W)
    same_PKK, different_PKK = _compared(_images(labels, [_PROMPT]), _images(labels, [_SCENE]))
    is_other_KK = (pairs.scenes[:, None] == pairs.scenes) & ~torch.eye(
        len(pairs.scenes), dtype=torch.bool, device=pairs.scenes.device
    )
    same_PKK, different_PKK = same_PKK & is_other_KK, different_PKK & is_other_KK
    scores_PKK = (prompt_PKW @ scene_PKW.mT).masked_fill(~(same_PKK | different_PKK), -2.0)
    is_correct_PK = same_PKK.gather(-1, scores_PKK.argmax(dim=-1, keepdim=True)).squeeze(-1)
    counts_PK = same_PKK.any(dim=-1) & different_PKK.any(dim=-1)
    rates = (is_correct_PK & counts_PK).sum(dim=-1) / counts_PK.sum(dim=-1)
    return {name: rate for name, rate in zip(ATTRIBUTES, rates.tolist(), strict=True) if not math.isnan(rate)}


def _images(labels: AttributeLabels, which: Sequence[int]) -> tuple[torch.Tensor, ...]:
    """Categories, colours and lengths of images, those of one kind of image after the other, (M, ...)."""
    columns = (labels.categories, labels.colours, labels.lengths)
    return tuple(column[:, list(which)].transpose(0, 1).flatten(0, 1) for column in columns)


def _compared(
    first: tuple[torch.Tensor, ...], second: tuple[torch.Tensor, ...]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Whether each attribute of two sets of images is alike, and whether it differs, both (P, M, N), bool."""
    texture_MN, shape_MN, profile_MN = (first[0][:, None] == second[0][None]).unbind(-1)
    colour_MN = 1 - torch.cdist(first[1], second[1], p=1) / 2
    ratio_MN2 = (first[2].log()[:, None] - second[2].log()[None]).abs()  # NaN is neither alike nor different
    height_MN, size_MN = (ratio_MN2 <= math.log(_LENGTH_LIMITS[0])).unbind(-1)
    other_height_MN, other_size_MN = (ratio_MN2 > math.log(_LENGTH_LIMITS[1])).unbind(-1)
    same = (texture_MN, colour_MN >= _COLOUR_LIMITS[0], shape_MN, profile_MN, height_MN, size_MN)
    different = (
        *(~texture_MN, colour_MN < _COLOUR_LIMITS[1], ~shape_MN, ~profile_MN),
        *(other_height_MN, other_size_MN),
    )
    return torch.stack(same), torch.stack(different)
