"""What words of a prompt say about objects: attributes to compare, what was named before, appearance.

"Put all objects with the same texture as {base} into it." A word selects the projection of the object's crops
and boxes under which objects are then compared: texture, colour, shape, profile, height or size alone.

Shape suffixes: V views, N objects, F width of crop features, P attributes, W width of a projection (in
`Coreference` of the text encoder), X all projections in one vector; B batch, T steps, L prompt positions,
A width of appearance; `...` any axes.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.batch import PromptBatch
from openvima.policies.nn.actions import mask_scores
from openvima.policies.nn.layers import mlp
from openvima.policies.nn.object_encoder import NUM_VIEWS, ObjectEncoderConfig
from openvima.policies.pointer.config import ATTRIBUTES, AttributeConfig
from openvima.policies.pointer.correspondence import ObjectFeatures
from openvima.policies.pointer.inputs import PointerPrompt

_BOX_UNIT_PX = 32.0  # sides of boxes are of this order
_HIDDEN_SIDE_PX = 24
_WORD_SCALE = 50.0  # logits in units of the weights, so that a few hundred steps of 1e-3 suffice
_UNKNOWN_WORD = -0.04  # weight of words that no caption has
_ALL = range(len(ATTRIBUTES))
_IN_APPEARANCE = tuple(map(ATTRIBUTES.index, ("texture", "shape")))


class Attributes(nn.Module):
    """A projection for each attribute, and the words that select them.

    "the same colour and shape" selects two, and the similarity is the mean of both cosines. Without a word of
    comparison, such as "same", a prompt selects none: "the shape in {scene}".

    Args:
        config: Sizes.
        images: Those of the object encoder, whose crop features are projected.
        vocabulary_size: Number of words.
    """

    def __init__(self, config: AttributeConfig, images: ObjectEncoderConfig, vocabulary_size: int) -> None:
        super().__init__()
        self._is_exclusive = config.exclusive
        widths = (NUM_VIEWS * (images.crop.output_width + 4), config.hidden_width, config.width)
        self.projections = nn.ModuleList(mlp(widths) for _ in ATTRIBUTES)
        # Logits of each word: which attributes it names, and last whether it compares.
        self.words = nn.Embedding(vocabulary_size, len(ATTRIBUTES) + 1)
        nn.init.constant_(self.words.weight, _UNKNOWN_WORD)

    def forward(
        self,
        features_VNF: torch.Tensor,
        boxes_VN4: torch.Tensor,
        masks_VN: torch.Tensor,
        which: Sequence[int] = _ALL,
    ) -> torch.Tensor:
        """Project objects; their cosines are similarities.

        Args:
            features_VNF: Crop features, shape (..., 2, N, F).
            boxes_VN4: Boxes in pixels, shape (..., 2, N, 4), integers.
            masks_VN: Whether the object is visible in the view, shape (..., 2, N), bool.
            which: Attributes to project to, as indices of `ATTRIBUTES`.

        Returns:
            Unit vectors, shape (..., N, P, W), where P counts those attributes.
        """
        # Without the column of the box, since pairs are mirrored in training.
        sizes_VN3 = boxes_VN4[..., 1:].to(features_VNF.dtype) / _BOX_UNIT_PX
        shown_VN1 = masks_VN[..., None].to(features_VNF.dtype)
        views_VNX = (
            torch.cat([features_VNF, sizes_VN3, torch.ones_like(sizes_VN3[..., :1])], dim=-1) * shown_VN1
        )
        both_NX = torch.cat(views_VNX.unbind(-3), dim=-1)
        return F.normalize(torch.stack([self.projections[p](both_NX) for p in which], dim=-2), dim=-1)

    def word_logits(self, word_ids_BL: torch.Tensor) -> torch.Tensor:
        """Logits of the attributes that each word names, and last of whether it compares, (B, L, P + 1)."""
        return _WORD_SCALE * self.words(word_ids_BL)

    def selected(self, prompts: PromptBatch) -> tuple[torch.Tensor, torch.Tensor]:
        """Read which attributes prompts ask to compare.

        Returns:
            The attributes, (B, P), and the words that name them, (B, L); both bool.
        """
        is_word_BL = (prompts.object_index_BL < 0) & prompts.mask_BL
        is_named_BLP = (self.word_logits(prompts.word_ids_BL) > 0) & is_word_BL[..., None]
        compares_B1 = is_named_BLP[..., -1].any(dim=1)[:, None]
        named_BLP = is_named_BLP[..., :-1] & compares_B1[..., None]
        return named_BLP.any(dim=1), named_BLP.any(dim=-1)

    def with_appearance(
        self,
        appearance_NA: torch.Tensor,
        features_VNF: torch.Tensor,
        boxes_VN4: torch.Tensor,
        masks_VN: torch.Tensor,
    ) -> torch.Tensor:
        """Join texture and shape to appearance: unit vectors whose cosine is the mean of the three.

        Where one errs on novel objects, the others seldom do: of the pallets of `pick_in_order_then_restore`
        at L3, all three find 92 %, appearance alone 75 % (50 to 60 episodes).
        """
        projected = self(features_VNF, boxes_VN4, masks_VN, _IN_APPEARANCE)
        joined = torch.cat([appearance_NA, projected.flatten(-2)], dim=-1)
        return joined / math.sqrt(1 + len(_IN_APPEARANCE))

    @staticmethod
    def joined_width(config: AttributeConfig) -> int:
        """Return by how much that widens an appearance."""
        return len(_IN_APPEARANCE) * config.width

    def embed(self, objects: ObjectFeatures, selected_BP: torch.Tensor) -> torch.Tensor:
        """Return vectors whose dot products are mean cosines of the selected attributes, (B, ..., N, X).

        They are zero, and cost nothing, where none is selected.
        """
        # Weights are square roots, since both sides of a dot product have them; prompts that select none,
        # which are most, are left out of the projections and get zeros.
        rows = torch.nonzero(selected_BP.any(dim=1))[:, 0]
        projected = self(objects.features_VNF[rows], objects.boxes_VN4[rows], objects.masks_VN[rows])
        weights_BP = selected_BP[rows].to(projected.dtype)
        weights_BP = (weights_BP / weights_BP.sum(dim=1, keepdim=True)).sqrt()
        weights_BP1 = weights_BP.view(len(rows), *(1,) * (projected.ndim - 3), weights_BP.shape[1], 1)
        embedded = projected.new_zeros(*objects.exists_N.shape, projected.shape[-2:].numel())
        return embedded.index_put((rows,), (projected * weights_BP1).flatten(-2))

    def hide_others(
        self, objects: ObjectFeatures, selected_BP: torch.Tensor, embedded_NX: torch.Tensor
    ) -> ObjectFeatures:
        """Hide what else objects, (B, ..., N), could be compared by, where attributes are selected.

        Args:
            objects: The objects.
            selected_BP: The attributes.
            embedded_NX: What `embed` returns for them.
        """
        features, boxes, appearance_NA = objects.features_VNF, objects.boxes_VN4, objects.appearance_NA
        is_shown = ~selected_BP.any(dim=1).view(-1, *(1,) * (features.ndim - 1))
        objects = replace(objects, features_VNF=features * is_shown)
        if not self._is_exclusive:
            return objects
        is_kept_4 = is_shown | (torch.arange(4, device=boxes.device) < 2)
        # Only their dot products count, so that zeros may stand beside them.
        apart_NX = torch.cat([appearance_NA * is_shown.squeeze(-1), embedded_NX], dim=-1)
        return replace(
            objects, boxes_VN4=torch.where(is_kept_4, boxes, _HIDDEN_SIDE_PX), appearance_NA=apart_NX
        )


class Coreference(nn.Module):
    """Adds to a word what the images look like that followed the same word before, gated by the word."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gate = nn.Linear(width, 1)

    def forward(
        self, tokens_BLW: torch.Tensor, images_BLW: torch.Tensor, weights_BLL: torch.Tensor
    ) -> torch.Tensor:
        """Map the input of the text encoder to the same shape; see `PromptEncoder.embed`, `coreference`."""
        return tokens_BLW + torch.sigmoid(self.gate(tokens_BLW)) * (weights_BLL @ images_BLW)


def coreference(prompts: PromptBatch) -> torch.Tensor:
    """Compute which images each word refers to.

    "This is a wug {image}." lets every later "wug" refer to that image, and "the {image}" every later "the":
    for which words that is meaningful is learned by the gate.

    Returns:
        Attention weights from words to positions, (B, L, L): uniform over the single image tokens that follow
        the same word earlier; zero if there are none.
    """
    is_image_BL = (prompts.object_index_BL >= 0) & prompts.mask_BL
    is_word_BL = (prompts.object_index_BL < 0) & prompts.mask_BL
    next_is_image_BL = F.pad(is_image_BL, (0, 1))[:, 1:]
    next_but_one_is_image_BL = F.pad(is_image_BL, (0, 2))[:, 2:]
    is_before_BL = is_word_BL & next_is_image_BL & ~next_but_one_is_image_BL  # of one object alone
    # "This is a wug {image}. … the wug": rows are words, columns the earlier same word that an image follows;
    # one step to the right is the image itself. Several images of one word share its weight of 1.
    same_BLL = prompts.word_ids_BL[:, :, None] == prompts.word_ids_BL[:, None]
    same_BLL = (same_BLL & is_word_BL[:, :, None] & is_before_BL[:, None]).tril(diagonal=-1)
    weights_BLL = F.pad(same_BLL[:, :, :-1], (1, 0))  # from the earlier word to the image behind it
    return weights_BLL / weights_BLL.sum(dim=-1, keepdim=True).clamp(min=1)


class TextGrounding(nn.Module):
    """Attends to words that describe appearance by their masked encoding, and returns what they describe.

    "Put the … into the red and blue stripe object." The appearance of a word does not depend on its context,
    so a texture that was named for objects to pick is known for containers, too. Attention may also go to
    no word. Among all words of a prompt it would find one without a description early in training, and never
    learn what the others mean.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)

    def forward(self, prompt: PointerPrompt, context_BTD: torch.Tensor) -> torch.Tensor:
        """Return the mean appearance of the attended words at each step, (B, T, A)."""
        return self.attention(prompt, context_BTD) @ prompt.text_appearance_BLA

    def attention(self, prompt: PointerPrompt, context_BTD: torch.Tensor) -> torch.Tensor:
        """Return the weights of the words at each step, (B, T, L); the rest of 1 goes to none."""
        if prompt.describes_BL is None:
            return context_BTD.new_zeros(*context_BTD.shape[:2], prompt.mask_BL.shape[-1])
        scores_BTL = attention_scores(
            self.query(context_BTD), self.key(prompt.masked_BLD), prompt.describes_BL
        )
        scores_BTL = F.pad(scores_BTL, (0, 1))  # the last score, 0, is that of none
        return torch.softmax(scores_BTL, dim=-1)[..., :-1]


def attention_scores(query_BTD: torch.Tensor, key_BLD: torch.Tensor, mask_BL: torch.Tensor) -> torch.Tensor:
    """Scores of scaled dot-product attention to positions of the prompt, (B, T, L)."""
    scores_BTL = query_BTD @ key_BLD.mT * query_BTD.shape[-1] ** -0.5
    return mask_scores(scores_BTL, mask_BL[:, None])
