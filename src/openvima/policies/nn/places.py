"""Batches of sequences without their padding: what is done to each place is done to those that exist alone.

Shape suffixes: B batch, L places, N those of all rows that are computed, D width.
"""

import torch


class Places:
    """Which places of a padded batch are computed; the others take part in attention alone, as zeros.

    Args:
        exist_BL: The places that are computed.
    """

    def __init__(self, exist_BL: torch.Tensor) -> None:
        self._shape = exist_BL.shape
        found_N = exist_BL.flatten().nonzero().squeeze(1)
        self._index_N = None if len(found_N) == exist_BL.numel() else found_N

    def pack(self, x_BLD: torch.Tensor) -> torch.Tensor:
        """Return the rows that are computed, (N, D); or the batch as it is, if that is all."""
        return x_BLD if self._index_N is None else x_BLD.flatten(0, 1).index_select(0, self._index_N)

    def unpack(self, x_ND: torch.Tensor) -> torch.Tensor:
        """Undo `pack`, with zeros at the other places."""
        if self._index_N is None:
            return x_ND
        zeros = x_ND.new_zeros(self._shape.numel(), x_ND.shape[-1])
        return zeros.index_copy(0, self._index_N, x_ND).unflatten(0, self._shape)
