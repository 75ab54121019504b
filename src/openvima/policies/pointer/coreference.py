"""Coreference in prompts: words attend to the images that followed the same word before.

Shape suffixes: B batch, L positions of the prompt, W width of the text encoder.
"""

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.batch import PromptBatch


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
    same_BLL = prompts.word_ids_BL[:, :, None] == prompts.word_ids_BL[:, None]
    same_BLL = (same_BLL & is_word_BL[:, :, None] & is_before_BL[:, None]).tril(diagonal=-1)
    weights_BLL = F.pad(same_BLL[:, :, :-1], (1, 0))  # from the earlier word to the image behind it
    return weights_BLL / weights_BLL.sum(dim=-1, keepdim=True).clamp(min=1)
