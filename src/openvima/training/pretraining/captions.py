"""Captions of rendered pairs: which attributes two objects share, in several words for each.

They are noun phrases ("the same colour and shape"), not instructions, and no task uses them as a prompt.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from openvima.policies.nn.tensor_record import TensorRecord
from openvima.policies.pointer.config import ATTRIBUTES
from openvima.policies.tokenizer import PADDING_ID

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
