"""The loss of contrastive pretraining, and the accuracy of retrieving objects by their embeddings."""

import torch
from torch.nn import functional as F

from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.policies.pointer.words import Attributes
from openvima.training.augmentation.channel_mixing import channel_mixing
from openvima.training.parallel import ONE_PROCESS, Parallel
from openvima.training.pretraining.attribute_loss import attribute_loss
from openvima.training.pretraining.pairs import Pairs
from openvima.training.pretraining.rotation import is_rotation_correct, rotation_loss

LossAndMetrics = tuple[torch.Tensor, dict[str, torch.Tensor]]


def contrastive_loss(
    encoder: ObjectEncoder,
    pairs: Pairs,
    *,
    temperature: float,
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
        temperature: Softmax temperature.
        generator: Draws the mixing of channels.
        attributes: Also gets the gradient of its own loss, on labelled pairs; None for none.
        attribute_weight: Weight of that loss.
        parallel: Processes that share the encoding of crops.

    Returns:
        The loss, and its parts and accuracies within the batch.

    Source: InfoNCE (van den Oord et al. 2018), symmetric as in CLIP.
    """
    mixing = channel_mixing(generator).to(pairs.scene_crops.device)
    if pairs.second_view is not None:
        return _two_view_loss(encoder, pairs, mixing, temperature, attributes, attribute_weight, parallel)
    features = _encoded(encoder, torch.stack([pairs.prompt_crops, pairs.scene_crops]), mixing, parallel)
    masks = torch.stack([pairs.prompt_masks, pairs.scene_masks]).transpose(1, 2)
    prompt, scene = encoder.embed_appearance(features, masks)
    loss, accuracy = info_nce(prompt, scene, matches(pairs), temperature=temperature)
    return loss, {"loss/contrastive": loss.detach(), "contrastive_accuracy": accuracy}


def _two_view_loss(
    encoder: ObjectEncoder,
    pairs: Pairs,
    mixing: torch.Tensor,
    temperature: float,
    attributes: Attributes | None,
    attribute_weight: float,
    parallel: Parallel,
) -> LossAndMetrics:
    view = pairs.second_view
    assert view is not None
    crops = torch.stack([pairs.prompt_crops, pairs.scene_crops, view.crops])
    features = _encoded(encoder, crops, mixing, parallel)
    masks = torch.stack([pairs.prompt_masks, pairs.scene_masks, view.masks]).transpose(1, 2)
    prompt, scene, second = encoder.embed_appearance(features, masks)
    rows = view.masks.any(dim=1)
    is_same = pairs.appearances[rows, None] == pairs.appearances[None, rows]
    prompt_loss, prompt_accuracy = info_nce(prompt, scene, matches(pairs), temperature=temperature)
    view_loss, view_accuracy = info_nce(second[rows], scene[rows], is_same, temperature=temperature)
    loss = (prompt_loss + view_loss) / 2
    metrics = {
        "loss/contrastive": prompt_loss.detach(),
        "loss/second_view": view_loss.detach(),
        "contrastive_accuracy": prompt_accuracy,
        "second_view_accuracy": view_accuracy,
    }
    if encoder.config.rotation_bins:
        of_rotations = rotation_loss(encoder, features, masks, view.rotations)
        is_correct = is_rotation_correct(encoder, features, masks, view.rotations)
        loss, metrics["loss/rotation"] = loss + of_rotations, of_rotations.detach()
        metrics["rotation_accuracy"] = is_correct.float().mean()
    if attributes and pairs.attributes:
        of_attributes = attribute_loss(attributes, features, masks, pairs.attributes, temperature=temperature)
        loss, metrics["loss/attributes"] = loss + attribute_weight * of_attributes, of_attributes.detach()
    return loss, metrics


def _encoded(
    encoder: ObjectEncoder, crops_SKVCYX: torch.Tensor, mixing: torch.Tensor, parallel: Parallel
) -> torch.Tensor:
    """Encode crops of S images of K objects, with mixed channels, to features (S, V, K, F)."""
    mixed = torch.einsum("cd,skvdyx->skvcyx", mixing, crops_SKVCYX.to(mixing.dtype))
    features_NF = parallel.in_parts(encoder.encode_images, mixed.flatten(0, 2))
    return features_NF.unflatten(0, crops_SKVCYX.shape[:3]).transpose(1, 2)


def matches(pairs: Pairs) -> torch.Tensor:
    """Return which prompt image (row) matches which object (column) of a batch, (K, K), bool.

    A coloured one matches objects of its appearance, a grayscale one those of its shape.
    """
    is_same_shape = (pairs.shapes[:, None] == pairs.shapes[None, :]) & pairs.is_grayscale[:, None]
    return is_same_shape | (pairs.appearances[:, None] == pairs.appearances[None, :])


def info_nce(
    first: torch.Tensor, second: torch.Tensor, is_match: torch.Tensor, *, temperature: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Symmetric InfoNCE loss of K objects, and the accuracy from first to second.

    Args:
        first: Embeddings, shape (K, A).
        second: Those of other images of the same objects, shape (K, A).
        is_match: Pairs that are no negatives, shape (K, K), bool.
        temperature: Softmax temperature.
    """
    scores = first @ second.T / temperature
    count = len(scores)
    diagonal = torch.eye(count, dtype=torch.bool, device=scores.device)
    scores = scores.masked_fill(is_match & ~diagonal, torch.finfo(scores.dtype).min)
    target = torch.arange(count, device=scores.device)
    loss = (F.cross_entropy(scores, target) + F.cross_entropy(scores.T, target)) / 2
    with torch.no_grad():
        accuracy = (scores.argmax(1) == target).to(scores.dtype).mean()
    return loss, accuracy


@torch.no_grad()
def retrieval_accuracy(encoder: ObjectEncoder, pairs: Pairs, *, chunk: int = 256) -> float:
    """Fraction of prompt images whose nearest object of the scene is a match."""
    rows = torch.arange(len(pairs.scenes), device=pairs.scenes.device).split(chunk)
    parts = [pairs.select(row) for row in rows]
    prompt = torch.cat([embedded(encoder, p.prompt_crops, p.prompt_masks) for p in parts])
    scene = torch.cat([embedded(encoder, p.scene_crops, p.scene_masks) for p in parts])
    is_other_scene = pairs.scenes[:, None] != pairs.scenes[None, :]
    nearest = (prompt @ scene.T).masked_fill(is_other_scene, -2.0).argmax(1)
    is_correct = pairs.appearances[nearest] == pairs.appearances
    is_correct |= pairs.is_grayscale & (pairs.shapes[nearest] == pairs.shapes)
    return float(is_correct.double().mean())


def embedded(encoder: ObjectEncoder, crops: torch.Tensor, masks: torch.Tensor) -> torch.Tensor:
    """Embed K objects; crops (K, 2, 3, 32, 32), masks (K, 2)."""
    return encoder.embed_appearance(encoder.encode_images(crops).transpose(0, 1), masks.T)
