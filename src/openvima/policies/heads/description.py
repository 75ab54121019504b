"""Which words of a prompt describe what is asked for, as in "… into the red and blue stripe object".

Shape suffixes as in `base.py`; M places of the prompt.
"""

import torch
from torch import nn

from openvima.policies.heads.base import HeadInputs


class Description(nn.Module):
    """Looks at words of the prompt, by their roles in it, and says how what they describe looks.

    How each word looks is the same whatever it is said of, so that a texture which was named for things to
    pick is known of containers, too.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)

    def forward(self, inputs: HeadInputs, context_BTD: torch.Tensor) -> torch.Tensor:
        """Return the mean look of the words that are attended to at each step, (B, T, A)."""
        looks_BMA, masks_BM = inputs.word_looks_BMA, inputs.prompt_exists_BM
        assert looks_BMA is not None and masks_BM is not None  # the network tells heads that copy
        return attended(self.query(context_BTD), self.key(inputs.prompt_BMD), masks_BM, looks_BMA)


def attended(
    query_BTD: torch.Tensor, key_BMD: torch.Tensor, masks_BM: torch.Tensor, looks_BMA: torch.Tensor
) -> torch.Tensor:
    """Return the mean look of the places of the prompt that are attended to, (B, T, A)."""
    scores_BTM = query_BTD @ key_BMD.mT * query_BTD.shape[-1] ** -0.5
    scores_BTM = scores_BTM.masked_fill(~masks_BM[:, None], torch.finfo(scores_BTM.dtype).min)
    return torch.softmax(scores_BTM, dim=-1) @ looks_BMA
