"""Contrastive pretraining as a stage of training, with its augmentation of crops and captions.

A caption tells which attributes two objects share, in several words for each. Captions are noun phrases ("the
same colour and shape"), not instructions, and no task uses them as a prompt.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn import functional as F

from openvima.policies.nn.layers import TensorRecord
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.pointer.config import ATTRIBUTES
from openvima.policies.pointer.model import Pointer
from openvima.policies.pointer.words import Attributes
from openvima.policies.tokenizer import PADDING_ID
from openvima.render.rasteriser import FLOOR_RGB, SHEET_RGB
from openvima.training.config import PretrainingConfig
from openvima.training.loop import Metrics, step_generator, step_seed
from openvima.training.parallel import Parallel
from openvima.training.pretraining.losses import (
    attribute_accuracy,
    contrastive_loss,
    retrieval_accuracy,
    rotation_accuracy,
)
from openvima.training.pretraining.pairs import SECOND_VIEW, Pairs

WORDS: dict[str, tuple[str, ...]] = {
    "texture": ("texture", "textures", "pattern", "patterns", "surface", "material"),
    "colour": ("colour", "color", "colours", "colors", "hue", "tint"),
    "shape": ("shape", "shapes", "form", "geometry"),
    "profile": ("profile", "profiles", "outline", "contour", "silhouette"),
    "height": ("height", "heights", "tallness", "thickness"),
    "size": ("size", "sizes", "width", "extent", "dimensions"),
}
"""Words that name each attribute."""

_COMPARISONS = ("same", "equal", "identical", "matching", "similar", "alike", "shared")
_COMPARING = ("the {same} {what}", "{same} {what}", "objects of {same} {what}", "{same} in {what}")
# Neither of these compares: an attribute may be named without, and without one "same" means the object.
_OTHERS = ("the {what} of this object", "another {what}", "a different {what}", "the {same} object")
_MOST_ATTRIBUTES = 3
# "The same shape" leaves open whether more than the outline is meant, so that both are compared.
_SHAPE, _PROFILE = ATTRIBUTES.index("shape"), ATTRIBUTES.index("profile")


@dataclass(frozen=True, slots=True, eq=False)
class Captions(TensorRecord):
    """Captions as word ids.

    Args:
        word_ids: Shape (K, L), int64, padded.
        targets: Whether each names an attribute, and last whether it compares, shape (K, P + 1), bool.
    """

    word_ids: torch.Tensor
    targets: torch.Tensor


def sample_captions(count: int, encode: Callable[[str], list[int]], rng: np.random.Generator) -> Captions:
    """Sample captions of free combinations of attributes.

    Args:
        count: Number of captions.
        encode: Encodes text as word ids.
        rng: Source of all draws.
    """
    ids, targets = [], np.zeros((count, len(ATTRIBUTES) + 1), np.bool_)
    for row in range(count):
        compares = rng.random() < 0.75
        templates = _COMPARING if compares else _OTHERS
        template = templates[int(rng.integers(len(templates)))]
        named = rng.permutation(len(ATTRIBUTES))[: int(rng.integers(1, _MOST_ATTRIBUTES + 1))]
        targets[row, named] = "{what}" in template
        targets[row, _PROFILE] |= targets[row, _SHAPE]
        targets[row, -1] = "{same}" in template
        words = [str(rng.choice(WORDS[ATTRIBUTES[index]])) for index in named]
        what = " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))
        ids.append(encode(template.format(same=rng.choice(_COMPARISONS), what=what)))
    length = max(map(len, ids))
    padded = [each + [PADDING_ID] * (length - len(each)) for each in ids]
    return Captions(torch.tensor(padded), torch.from_numpy(targets))


def caption_texts() -> Iterator[str]:
    """Yield texts with all words of captions, for the vocabulary."""
    yield from (" ".join(words) for words in WORDS.values())
    yield " ".join(_COMPARISONS)
    yield from (template.format(same="", what="") for template in (*_COMPARING, *_OTHERS))
    yield "and ,"


def with_horizontal_flips(pairs: Pairs, generator: torch.Generator) -> Pairs:
    """Mirror all images of half of the objects, drawn at random, and reverse their rotations.

    Both cameras look at the table from its middle, so that mirrored images are images of mirrored objects.
    """
    assert pairs.rotations is not None  # only pairs with a second view are flipped
    is_flipped = (torch.rand(len(pairs.scenes), generator=generator) < 0.5).to(pairs.scenes.device)
    return replace(
        pairs,
        crops=torch.where(is_flipped.view(-1, 1, 1, 1, 1, 1), pairs.crops.flip(-1), pairs.crops),
        rotations=torch.where(is_flipped[:, None], -pairs.rotations, pairs.rotations),
    )


# Augmentation of crops; shape suffixes: K objects, D draws, Y rows, X columns of a crop.
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


_NUM_CAPTIONS, _CAPTION_BATCH = 4096, 64
_VALIDATION_SCENES = 0.05  # the last ones
_PURPOSE = "1-matching"  # hashed into the seed of every batch; changing it would change all runs


def caption_loss(attributes: Attributes, captions: Captions) -> torch.Tensor:
    """Cross-entropy of the attributes that captions name: those that any of their words does (noisy or)."""
    is_word_BL1 = (captions.word_ids != PADDING_ID)[..., None]
    none_BP = (F.softplus(attributes.word_logits(captions.word_ids)) * is_word_BL1).sum(dim=1)
    return torch.where(captions.targets, -torch.log(-torch.expm1(-none_BP)), none_BP).mean()


class ContrastivePretraining:
    """Trains the crop encoder, appearance embedding and relative rotation on rendered pairs.

    Processes share the encoding of crops, and do the rest alike.

    Args:
        network: Its object encoder is trained.
        config: Settings of the stage.
        seed: Of the run.
        pairs: Objects in prompt images and scenes, on the device of the network.
        parallel: The processes of the run.
        encode: Encodes the captions of attributes, if they are trained.
    """

    name = "1-pretraining"
    learning_rate = 1e-3

    def __init__(
        self,
        network: PolicyNetwork,
        config: PretrainingConfig,
        seed: int,
        pairs: Pairs,
        parallel: Parallel,
        encode: Callable[[str], list[int]],
    ) -> None:
        assert network.object_encoder is not None  # `resolved` has checked it
        self.encoder = network.object_encoder
        self.parameters = crop_parameters(network)
        held_out = pairs.scenes >= int(pairs.scenes.max()) * (1 - _VALIDATION_SCENES)
        self._training = pairs.select(torch.nonzero(~held_out)[:, 0])
        self._validation = pairs.select(torch.nonzero(held_out)[:, 0])
        self._config, self._seed, self._parallel = config, seed, parallel
        self._attributes = attributes_of(network) if config.attribute_loss_weight else None
        if self._attributes:
            rng = np.random.default_rng(step_seed(seed, "captions", 0))
            self._captions = sample_captions(_NUM_CAPTIONS, encode, rng).to(pairs.scenes.device)

    def backward(self, step: int) -> Metrics:
        """Draw a batch of pairs and add its gradients."""
        config = self._config
        generator = step_generator(self._seed, _PURPOSE, step)
        scenes = self._training.scenes
        if config.hard_negative_prob:  # whole scenes, as these contain hard negatives
            rank = torch.rand(int(scenes.max()) + 1, generator=generator)
            order = rank[scenes.cpu()].argsort(stable=True)
        else:
            order = torch.randperm(len(scenes), generator=generator)
        batch = self._training.select(order[: config.batch_size].to(scenes.device))
        if self.encoder.config.rotation_bins:
            batch = with_horizontal_flips(batch, generator)
        if config.occlusion_prob:
            batch = with_occlusion(batch, config.occlusion_prob, generator)
        if config.box_jitter_px:
            batch = with_box_jitter(batch, config.box_jitter_px, generator)
        loss, metrics = contrastive_loss(
            self.encoder,
            batch,
            generator=generator,
            attributes=self._attributes,
            attribute_weight=config.attribute_loss_weight,
            parallel=self._parallel,
        )
        if self._attributes:
            rows = torch.randint(len(self._captions.targets), (_CAPTION_BATCH,), generator=generator)
            metrics["loss/captions"] = caption_loss(self._attributes, self._captions.select(rows))
            loss = loss + metrics["loss/captions"]
        loss.backward()
        self._parallel.average_gradients(self.parameters)
        return {"loss": loss.item(), **{name: value.item() for name, value in metrics.items()}}

    def validate(self) -> Metrics:
        """Return the accuracy of retrieving objects of held-out scenes, and of their rotations.

        Objects are retrieved among those of their scene: by prompt image, and by the second view if scenes
        have one.
        """
        pairs = self._validation
        metrics = {"retrieval_accuracy": retrieval_accuracy(self.encoder, pairs)}
        if pairs.rotations is not None:
            metrics["second_view_accuracy"] = retrieval_accuracy(self.encoder, pairs.second_view_pairs())
        if self.encoder.config.rotation_bins:
            metrics["rotation_accuracy"] = rotation_accuracy(self.encoder, pairs)
        if self._attributes:
            of_attributes = attribute_accuracy(self.encoder, self._attributes, pairs)
            metrics |= {f"{name}_accuracy": value for name, value in of_attributes.items()}
        return metrics


def attributes_of(network: PolicyNetwork) -> Attributes | None:
    """Return the attributes in which a network compares objects, if it does."""
    return network.attributes if isinstance(network, Pointer) else None


def crop_parameters(network: PolicyNetwork) -> list[torch.nn.Parameter]:
    """Return what pretraining trains, and behaviour cloning keeps frozen."""
    encoder = network.object_encoder
    assert encoder is not None  # only networks with an appearance embedding are pretrained or frozen
    appearance = list(encoder.appearance.parameters()) if encoder.config.appearance_width else []
    rotation = list(encoder.rotation.parameters()) if encoder.config.rotation_bins else []
    of_attributes = list(attributes.parameters()) if (attributes := attributes_of(network)) else []
    return [*encoder.crop_encoder.parameters(), *appearance, *rotation, *of_attributes]
