"""Grounding: which objects and words of the prompt are meant, and what they look like.

Shape suffixes as in `inputs.py`.
"""

import torch
from torch import nn

from openvima.policies.pointer.inputs import PointerPrompt, mask_scores


class TextGrounding(nn.Module):
    """Attends to words by their masked encoding, and returns the appearance they describe.

    "Put the … into the red and blue stripe object." The appearance of a word does not depend on its context,
    so a texture that was named for objects to pick is known for containers, too.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)

    def forward(self, prompt: PointerPrompt, context_BTD: torch.Tensor) -> torch.Tensor:
        """Return the mean appearance of the attended words at each step, (B, T, A)."""
        if not prompt.describes:
            return context_BTD.new_zeros(*context_BTD.shape[:2], prompt.text_appearance_BLA.shape[-1])
        return self.attention(prompt, context_BTD) @ prompt.text_appearance_BLA

    def attention(self, prompt: PointerPrompt, context_BTD: torch.Tensor) -> torch.Tensor:
        """Return the weights of the words at each step, (B, T, L)."""
        return attention(self.query(context_BTD), self.key(prompt.masked_BLD), prompt.mask_BL)


def attention(query_BTD: torch.Tensor, key_BLD: torch.Tensor, mask_BL: torch.Tensor) -> torch.Tensor:
    """Weights of scaled dot-product attention to positions of the prompt, (B, T, L)."""
    scores_BTL = query_BTD @ key_BLD.mT * query_BTD.shape[-1] ** -0.5
    return torch.softmax(mask_scores(scores_BTL, mask_BL[:, None]), dim=-1)
