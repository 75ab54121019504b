"""Losses and accuracies of contrastive pretraining: of appearance, relative rotation, attributes.

Shape suffixes: K objects, M and N images of objects, V views, F features, R rotation bins, P attributes, W
width of a projection; a leading 2 or 3 counts images.
"""

import math
from collections.abc import Sequence

import torch
from torch.nn import functional as F

from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.policies.pointer.config import ATTRIBUTES
from openvima.policies.pointer.words import Attributes
from openvima.training.learner import LossAndMetrics
from openvima.training.parallel import ONE_PROCESS, Parallel
from openvima.training.pretraining.pairs import PROMPT, SCENE, SECOND_VIEW, AttributeLabels, Pairs

TEMPERATURE = 0.07  # of every softmax
_CHUNK = 256  # pairs that are encoded at a time in validation


def contrastive_loss(
    encoder: ObjectEncoder,
    pairs: Pairs,
    *,
    generator: torch.Generator,
    attributes: Attributes | None = None,
    attribute_weight: float = 1.0,
    parallel: Parallel = ONE_PROCESS,
) -> LossAndMetrics:
    """InfoNCE loss between prompt images and scenes; with second views also theirs, and that of rotations.

    Channels of the whole batch are mixed at random first: more colours than the partition has, as hard to
    tell apart as before.

    Args:
        encoder: Gets the gradient. Without rotation bins only appearances count.
        pairs: A batch.
        generator: Draws the mixing of channels.
        attributes: Also gets the gradient of its own loss, on labelled pairs; None for none.
        attribute_weight: Weight of that loss.
        parallel: Processes that share the encoding of crops.

    Returns:
        The loss, and its parts and accuracies within the batch.

    Source: InfoNCE (van den Oord et al. 2018), symmetric as in CLIP.
    """
    mixing = draw_channel_mixing(generator).to(pairs.crops.device)
    crops_SKVCYX = pairs.crops.transpose(0, 1).contiguous()
    mixed = torch.einsum("cd,skvdyx->skvcyx", mixing, crops_SKVCYX.to(mixing.dtype))
    features_NF = parallel.in_parts(encoder.encode_images, mixed.flatten(0, 2))
    features = features_NF.unflatten(0, crops_SKVCYX.shape[:3]).transpose(1, 2)  # (S, V, K, F)
    masks = pairs.masks.permute(1, 2, 0)
    prompt, scene, *second = encoder.embed_appearance(features, masks)
    loss, accuracy = info_nce(prompt, scene, find_matches(pairs))
    metrics = {"loss/contrastive": loss, "contrastive_accuracy": accuracy}
    if pairs.rotations is None:
        return loss, metrics
    rows = pairs.masks[:, SECOND_VIEW].any(dim=1)
    is_same = pairs.appearances[rows, None] == pairs.appearances[None, rows]
    view_loss, accuracy = info_nce(second[0][rows], scene[rows], is_same)
    loss = (loss + view_loss) / 2
    metrics |= {"loss/second_view": view_loss, "second_view_accuracy": accuracy}
    if encoder.config.rotation_bins:
        of_rotations = rotation_loss(encoder, features, masks, pairs.rotations)
        is_correct = is_rotation_correct(encoder, features, masks, pairs.rotations)
        loss, metrics["loss/rotation"] = loss + of_rotations, of_rotations
        metrics["rotation_accuracy"] = is_correct.float().mean()
    if attributes and pairs.attributes:
        of_attributes = attribute_loss(attributes, features, masks, pairs.attributes)
        loss, metrics["loss/attributes"] = loss + attribute_weight * of_attributes, of_attributes
    return loss, metrics


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


def find_matches(pairs: Pairs) -> torch.Tensor:
    """Return which prompt image (row) matches which object (column) of a batch, (K, K), bool.

    A coloured one matches objects of its appearance, a grayscale one those of its shape.
    """
    is_same_shape = (pairs.shapes[:, None] == pairs.shapes[None, :]) & pairs.is_grayscale[:, None]
    return is_same_shape | (pairs.appearances[:, None] == pairs.appearances[None, :])


def info_nce(
    first: torch.Tensor, second: torch.Tensor, is_match: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Symmetric InfoNCE loss of K objects, and the accuracy from first to second.

    Args:
        first: Embeddings, shape (K, A).
        second: Those of other images of the same objects, shape (K, A).
        is_match: Pairs that are no negatives, shape (K, K), bool.
    """
    scores = first @ second.T / TEMPERATURE
    count = len(scores)
    diagonal = torch.eye(count, dtype=torch.bool, device=scores.device)
    # Others of the same appearance are no negatives: they are masked, and the diagonal stays the target.
    scores = scores.masked_fill(is_match & ~diagonal, torch.finfo(scores.dtype).min)
    target = torch.arange(count, device=scores.device)
    loss = (F.cross_entropy(scores, target) + F.cross_entropy(scores.T, target)) / 2
    return loss, (scores.argmax(1) == target).to(scores.dtype).mean()


def _chunks(pairs: Pairs) -> list[Pairs]:
    """Divide held-out pairs, as crops of all would take too much memory at once."""
    rows = torch.arange(len(pairs.scenes), device=pairs.scenes.device).split(_CHUNK)
    return list(map(pairs.select, rows))


@torch.no_grad()
def retrieval_accuracy(encoder: ObjectEncoder, pairs: Pairs) -> float:
    """Fraction of prompt images whose nearest object of the scene is a match."""
    parts = _chunks(pairs)
    prompt = torch.cat([embed(encoder, p.crops[:, PROMPT], p.masks[:, PROMPT]) for p in parts])
    scene = torch.cat([embed(encoder, p.crops[:, SCENE], p.masks[:, SCENE]) for p in parts])
    is_other_scene = pairs.scenes[:, None] != pairs.scenes[None, :]
    nearest = (prompt @ scene.T).masked_fill(is_other_scene, -2.0).argmax(1)
    is_correct = pairs.appearances[nearest] == pairs.appearances
    is_correct |= pairs.is_grayscale & (pairs.shapes[nearest] == pairs.shapes)
    return float(is_correct.double().mean())


def embed(encoder: ObjectEncoder, crops: torch.Tensor, masks: torch.Tensor) -> torch.Tensor:
    """Embed K objects; crops (K, 2, 3, 32, 32), masks (K, 2)."""
    return encoder.embed_appearance(encoder.encode_images(crops).transpose(0, 1), masks.T)


TOLERANCE_RAD = math.radians(15)  # as in `rotate` and `twist`


def rotation_loss(
    encoder: ObjectEncoder, features_3VKF: torch.Tensor, masks_3VK: torch.Tensor, rotations_K2: torch.Tensor
) -> torch.Tensor:
    """Cross-entropy of the rotations between any two of three images, with linear weights of adjacent bins.

    Args:
        encoder: One with rotation bins.
        features_3VKF: Crop features in the prompt image, the scene, and the second view.
        masks_3VK: Whether the object is visible there, shape (3, 2, K).
        rotations_K2: Rotations from each image to the next, in radians; NaN is ignored.
    """
    first, second = rotations_K2.unbind(1)
    losses = []
    for a, b, rotations in ((0, 1, first), (1, 2, second), (0, 2, first + second)):
        scores_KR, rotations = _compare_rotations(
            encoder, features_3VKF[[a, b]], masks_3VK[[a, b]], rotations
        )
        bins = scores_KR.shape[-1]
        position = rotations * (bins / (2 * math.pi))
        # A rotation between two bins counts for both, the more the nearer: bins are a circle, hence the
        # modulo.
        low = position.floor()
        weight = (position - low).to(scores_KR.dtype)
        of_low = F.nll_loss(scores_KR, low.long() % bins, reduction="none")
        of_high = F.nll_loss(scores_KR, (low.long() + 1) % bins, reduction="none")
        losses.append((1 - weight) * of_low + weight * of_high)
    return torch.cat(losses).sum() / max(1, sum(map(len, losses)))


@torch.no_grad()
def rotation_accuracy(encoder: ObjectEncoder, pairs: Pairs) -> float:
    """Fraction of rotations to the second view estimated within 15 degrees; NaN if there is none."""
    is_correct = []
    for part in _chunks(pairs):
        assert part.rotations is not None
        features, masks = _features(encoder, part, [SCENE, SECOND_VIEW])
        is_correct.append(is_rotation_correct(encoder, features, masks, part.rotations))
    return float(torch.cat(is_correct).double().mean())


def _features(
    encoder: ObjectEncoder, pairs: Pairs, images: Sequence[int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Encode crops of some of the S images; return features (S, V, K, F), and masks (S, V, K)."""
    crops = pairs.crops[:, images].transpose(0, 1)
    return encoder.encode_images(crops).transpose(1, 2), pairs.masks[:, images].permute(1, 2, 0)


@torch.no_grad()
def is_rotation_correct(
    encoder: ObjectEncoder, features: torch.Tensor, masks: torch.Tensor, rotations_K2: torch.Tensor
) -> torch.Tensor:
    """Return whether the rotation between the last two images is within tolerance; (at most K,), bool."""
    scores_KR, rotations = _compare_rotations(encoder, features[-2:], masks[-2:], rotations_K2[:, 1])
    estimates = scores_KR.argmax(dim=-1) * (2 * math.pi / scores_KR.shape[-1])
    error = torch.remainder(estimates - rotations + math.pi, 2 * math.pi) - math.pi
    return error.abs() <= TOLERANCE_RAD


def _compare_rotations(
    encoder: ObjectEncoder, features_2VKF: torch.Tensor, masks_2VK: torch.Tensor, rotations_K: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return scores and true rotations of objects that have one and share a view in both images."""
    is_seen = (masks_2VK[0] & masks_2VK[1]).any(dim=0)
    rows = torch.nonzero(is_seen & ~rotations_K.isnan())[:, 0]
    (first, second), (seen, seen_again) = features_2VKF[:, :, rows], masks_2VK[:, :, rows]
    return encoder.rotation(first, second, seen, seen_again), rotations_K[rows]


# Intersection of colour histograms, and ratio of lengths: alike from or up to the first, different beyond the
# second. In between nothing is learned: a red and blue stripe is neither like red nor unlike it.
_COLOUR_LIMITS = (0.7, 0.4)
_LENGTH_LIMITS = (1.12, 1.3)


def attribute_loss(
    attributes: Attributes,
    features_3VKF: torch.Tensor,
    masks_3VK: torch.Tensor,
    labels: AttributeLabels,
) -> torch.Tensor:
    """Supervised contrastive loss, mean over attributes.

    Each positive competes with all negatives of its anchor, and not with other positives. Objects that are
    neither alike nor different do not count.

    Args:
        attributes: Gets the gradient, as the features do.
        features_3VKF: Crop features in the prompt image, the scene, and the second view.
        masks_3VK: Whether the object is visible there, shape (3, 2, K).
        labels: Of the objects.

    Source: SupCon (Khosla et al. 2020), its loss "out", with one positive at a time in the denominator.
    """
    projected_3KPW = attributes(features_3VKF, labels.boxes.permute(1, 2, 0, 3), masks_3VK)
    projected_PMW = projected_3KPW.flatten(0, 1).transpose(0, 1)
    images = _images(labels, (PROMPT, SCENE, SCENE))  # the second view has no labels of its own
    same_PMM, different_PMM = _compare_attributes(images, images)
    is_seen_M = masks_3VK.any(dim=1).flatten()
    is_pair_MM = is_seen_M & is_seen_M[:, None]
    different_PMM = different_PMM & is_pair_MM
    same_PMM = same_PMM & is_pair_MM & ~torch.eye(len(is_seen_M), dtype=torch.bool, device=is_seen_M.device)
    scores_PMM = projected_PMW @ projected_PMW.mT / TEMPERATURE
    lowest = torch.finfo(scores_PMM.dtype).min
    # Each pair that is alike is one softmax against all that differ, summed as softplus; pairs that are
    # neither alike nor different take no part. Rows (M) are the objects of all three images, one matrix per
    # attribute.
    negatives_PM1 = scores_PMM.masked_fill(~different_PMM, lowest).logsumexp(dim=-1, keepdim=True)
    nll_PM = (F.softplus(negatives_PM1 - scores_PMM) * same_PMM).sum(dim=-1)
    count_PM = same_PMM.sum(dim=-1)
    has_both_PM = (count_PM > 0) & different_PMM.any(dim=-1)
    nll_PM = nll_PM / count_PM.clamp(min=1) * has_both_PM
    return (nll_PM.sum(dim=-1) / has_both_PM.sum(dim=-1).clamp(min=1)).mean()


@torch.no_grad()
def attribute_accuracy(encoder: ObjectEncoder, attributes: Attributes, pairs: Pairs) -> dict[str, float]:
    """How often the most similar other object of the scene is alike, by name of the attribute.

    Only prompt images count for which the scene has another object that is alike and one that differs;
    attributes without any are left out.
    """
    labels = pairs.attributes
    assert labels is not None
    projected = []
    for part, boxes in zip(_chunks(pairs), labels.boxes.split(_CHUNK), strict=True):
        features, masks = _features(encoder, part, [PROMPT, SCENE])
        boxes = boxes[:, : len(masks)].permute(1, 2, 0, 3)
        projected.append(attributes(features, boxes, masks).transpose(1, 2))  # (2, P, K, W)
    prompt_PKW, scene_PKW = torch.cat(projected, dim=2)  # of (2, P, K, W)
    same_PKK, different_PKK = _compare_attributes(_images(labels, [PROMPT]), _images(labels, [SCENE]))
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


def _compare_attributes(
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
