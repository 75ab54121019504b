"""Removes the padding of a batch of sequences, so that it costs no computation.

Shape suffixes: B batch, L positions, N positions of all rows that are computed, D width.
"""

import torch
from torch.nn import functional as F

from openvima.policies.nn.linear import rounded_rows


class Unpadder:
    """Packs the valid positions of a padded batch and scatters them back.

    In training the rows are rounded up by copies of the first, which are dropped again; see `rounded_rows`.

    Args:
        valid_BL: The positions that are computed; the others are zero, and visible to attention alone.
    """

    def __init__(self, valid_BL: torch.Tensor) -> None:
        self._shape = valid_BL.shape
        index_N = valid_BL.flatten().nonzero().squeeze(1)
        self._index_N = None if len(index_N) == valid_BL.numel() else index_N
        self._count = len(index_N)
        if self._index_N is not None and torch.is_grad_enabled():
            self._index_N = F.pad(index_N, (0, rounded_rows(self._count) - self._count))

    def unpad(self, x_BLD: torch.Tensor) -> torch.Tensor:
        """Return the valid rows, (N, D), or the batch unchanged if all are."""
        return x_BLD if self._index_N is None else x_BLD.flatten(0, 1).index_select(0, self._index_N)

    def pad(self, x_ND: torch.Tensor) -> torch.Tensor:
        """Undo `unpad`, with zeros at invalid positions."""
        if self._index_N is None:
            return x_ND
        zeros = x_ND.new_zeros(self._shape.numel(), x_ND.shape[-1])
        return zeros.index_copy(0, self._index_N[: self._count], x_ND[: self._count]).unflatten(
            0, self._shape
        )
