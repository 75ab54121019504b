"""Words that a picture explained before, as in "This is a wug {image}. Put the wug into the {other}.".

Shape suffixes: B batch, L prompt places.
"""

import torch
from torch.nn import functional as F


def referents(
    word_ids_BL: torch.Tensor, object_index_BL: torch.Tensor, mask_BL: torch.Tensor
) -> torch.Tensor:
    """Find the pictures that stood behind a word before.

    "This is a wug {image}." lets every later "wug" refer to that picture. So does "the {image}" for every
    later "the": which words it means something for, a network has to learn.

    Args:
        word_ids_BL: Word ids.
        object_index_BL: Row of the image token that stands at a place; negative where a word stands.
        mask_BL: Which places are valid.

    Returns:
        For each place the shares of the places that it refers to, (B, L, L): of each word the places of
        single image tokens that follow the same word earlier, in equal shares; zero if there are none.
    """
    is_image_BL = (object_index_BL >= 0) & mask_BL
    is_word_BL = (object_index_BL < 0) & mask_BL
    next_is_image_BL = F.pad(is_image_BL, (0, 1))[:, 1:]
    next_but_one_is_image_BL = F.pad(is_image_BL, (0, 2))[:, 2:]
    is_before_BL = is_word_BL & next_is_image_BL & ~next_but_one_is_image_BL  # of one object alone
    same_BLL = word_ids_BL[:, :, None] == word_ids_BL[:, None]
    same_BLL = (same_BLL & is_word_BL[:, :, None] & is_before_BL[:, None]).tril(diagonal=-1)
    refers_BLL = F.pad(same_BLL[:, :, :-1], (1, 0))  # from the earlier word to the picture behind it
    return refers_BLL / refers_BLL.sum(dim=-1, keepdim=True).clamp(min=1)
