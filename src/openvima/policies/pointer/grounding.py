"""Grounding: which objects and words of the prompt are meant, and what they look like.

Shape suffixes as in `inputs.py`.
"""

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.pointer.inputs import PointerPrompt, mask_scores


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
        if prompt.describes_BL is None:
            return context_BTD.new_zeros(*context_BTD.shape[:2], prompt.text_appearance_BLA.shape[-1])
        return self.attention(prompt, context_BTD) @ prompt.text_appearance_BLA

    def attention(self, prompt: PointerPrompt, context_BTD: torch.Tensor) -> torch.Tensor:
        """Return the weights of the words at each step, (B, T, L); the rest of 1 goes to none."""
        if prompt.describes_BL is None:
            return context_BTD.new_zeros(*context_BTD.shape[:2], prompt.mask_BL.shape[-1])
        scores_BTL = attention_scores(
            self.query(context_BTD), self.key(prompt.masked_BLD), prompt.describes_BL
        )
        return torch.softmax(F.pad(scores_BTL, (0, 1)), dim=-1)[
            ..., :-1
        ]  # the last score, 0, is that of none


def attention_scores(query_BTD: torch.Tensor, key_BLD: torch.Tensor, mask_BL: torch.Tensor) -> torch.Tensor:
    """Scores of scaled dot-product attention to positions of the prompt, (B, T, L)."""
    scores_BTL = query_BTD @ key_BLD.mT * query_BTD.shape[-1] ** -0.5
    return mask_scores(scores_BTL, mask_BL[:, None])
