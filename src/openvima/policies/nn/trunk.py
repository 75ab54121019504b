"""The two trunks: how a history of tokens is read in the light of a prompt.

`Decoder` looks at the prompt through cross-attention (VIMA, VIMA-Flamingo); `PrefixTrunk` has the prompt
stand before the history in one sequence (VIMA-Gato, VIMA-GPT). Both read a history piece by piece, keeping
keys and values of what they have read; a whole history is one long piece. So training and acting run the same
code.

Shape suffixes: B batch, L new places, N those of all rows that are computed, S all places so far, P places of
the prompt, D width, H heads, K width of a head.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import nn
from torch.nn import functional as F

from openvima.errors import ConfigError, PolicyError
from openvima.policies.nn.linear import Linear
from openvima.policies.nn.mlp import normal_weights
from openvima.policies.nn.places import Places

MAX_PLACES = 512  # of the history; with a prefix, of prompt and history together
MAX_PROMPT_PLACES = 256

KeysValues = tuple[torch.Tensor, torch.Tensor]  # (B, H, S, K) each


@dataclass(frozen=True, slots=True)
class DecoderConfig:
    """Sizes of the decoder with cross-attention.

    Args:
        width: Width of its tokens.
        num_layers: Pairs of a cross block and a self block.
        num_self_heads: Heads of self-attention.
        num_cross_heads: Heads of cross-attention.
        dropout: Share of values dropped in training, in self blocks and after the position embedding.
        initial_std: Standard deviation of fresh weights.
    """

    width: int
    num_layers: int
    num_self_heads: int
    num_cross_heads: int
    dropout: float = 0.1
    initial_std: float = 0.02

    def __post_init__(self) -> None:
        _check_sizes("decoder", self.width, self.num_self_heads, self.dropout)
        _check_sizes("decoder", self.width, self.num_cross_heads, self.dropout)


@dataclass(frozen=True, slots=True)
class PrefixConfig:
    """Sizes of the trunk that has the prompt before the history.

    Args:
        width: Width of its tokens.
        num_layers: Self blocks.
        num_heads: Heads of each.
        dropout: Share of values dropped in training, in the blocks and after the position embedding.
        initial_std: Standard deviation of fresh weights.
    """

    width: int
    num_layers: int
    num_heads: int
    dropout: float = 0.1
    initial_std: float = 0.02

    def __post_init__(self) -> None:
        _check_sizes("prefix trunk", self.width, self.num_heads, self.dropout)


@dataclass(frozen=True, slots=True, eq=False)
class TrunkState:
    """What a trunk keeps of what it has read.

    Args:
        past: Keys and values of each self block.
        mask_BS: Which of these places may be looked at.
        num_read_B: How many may; the next place gets this number as its position.
        prompt: Keys and values of each cross block; empty with a prefix.
        prompt_mask_BP: Which places of the prompt may be looked at.
    """

    past: tuple[KeysValues, ...]
    mask_BS: torch.Tensor
    num_read_B: torch.Tensor
    prompt: tuple[KeysValues, ...]
    prompt_mask_BP: torch.Tensor

    def select(self, rows: Sequence[int]) -> "TrunkState":
        """Return the state of some rows of the batch."""
        index = torch.as_tensor(rows, dtype=torch.int64, device=self.mask_BS.device)
        return TrunkState(
            tuple((key[index], value[index]) for key, value in self.past),
            self.mask_BS[index],
            self.num_read_B[index],
            tuple((key[index], value[index]) for key, value in self.prompt),
            self.prompt_mask_BP[index],
        )


class Trunk(nn.Module):
    """Positions and self blocks, which both trunks have."""

    sequence = "the history"  # what has places in the position table

    def __init__(self, width: int, num_layers: int, num_heads: int, dropout: float) -> None:
        super().__init__()
        self.width, self.num_heads = width, num_heads
        self.positions = nn.Embedding(MAX_PLACES, width)
        self.self_blocks = nn.ModuleList(SelfBlock(width, num_heads, dropout) for _ in range(num_layers))
        self.dropout = nn.Dropout(dropout)

    def begin(self, prompt_BPD: torch.Tensor, mask_BP: torch.Tensor) -> TrunkState:
        """Read the prompt; needed once an episode.

        Args:
            prompt_BPD: Encoded prompt.
            mask_BP: Which of its places are valid, bool.

        Raises:
            PolicyError: The prompt has more places than the position table.
        """
        raise NotImplementedError

    def extend(
        self,
        state: TrunkState,
        tokens_BLD: torch.Tensor,
        mask_BL: torch.Tensor,
        exist_BL: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, TrunkState]:
        """Read on.

        Args:
            state: What has been read.
            tokens_BLD: Objects and actions in the order of time.
            mask_BL: Which of these places may be looked at, bool. Masked places still get an output.
            exist_BL: Which get one, bool, those of the mask among them; all by default. It is zero elsewhere.

        Returns:
            Outputs, shape (B, L, D), and the state after them. A place sees the valid places before
            it, and itself if it is valid. Reading in pieces gives the outputs of reading at once, but for
            rounding.

        Raises:
            PolicyError: The history has more places than the position table.
        """
        num_read_B = state.num_read_B + mask_BL.sum(dim=1)
        if state.mask_BS.shape[1] + tokens_BLD.shape[1] > MAX_PLACES:  # only then worth a look at the data
            _check_length(int(num_read_B.max()), MAX_PLACES, self.sequence)
        positions_BL = (state.num_read_B[:, None] + mask_BL.cumsum(dim=1) - 1).clamp(min=0)
        places = Places(torch.ones_like(mask_BL) if exist_BL is None else exist_BL)
        x_ND = self.dropout(places.pack(tokens_BLD + self.positions(positions_BL)))
        seen_B1LS = score_bias(_seen(state.mask_BS, mask_BL)[:, None], x_ND.dtype)
        seen_B11P = score_bias(state.prompt_mask_BP[:, None, None, :], x_ND.dtype)
        past = []
        for layer, block in enumerate(self.self_blocks):
            x_ND = self._condition(layer, x_ND, places, state, seen_B11P)
            x_ND, keys_values = block(x_ND, places, state.past[layer], seen_B1LS)
            past.append(keys_values)
        mask_BS = torch.cat([state.mask_BS, mask_BL], dim=1)
        return places.unpack(x_ND), replace(state, past=tuple(past), mask_BS=mask_BS, num_read_B=num_read_B)

    def _condition(
        self, layer: int, x_ND: torch.Tensor, places: Places, state: TrunkState, seen_B11P: torch.Tensor
    ) -> torch.Tensor:
        """Look at the prompt before a self block, if the trunk does that."""
        return x_ND

    def _nothing_read(self, prompt_BPD: torch.Tensor, mask_BP: torch.Tensor) -> TrunkState:
        batch = len(prompt_BPD)
        nothing = prompt_BPD.new_zeros(batch, self.num_heads, 0, self.width // self.num_heads)
        return TrunkState(
            ((nothing, nothing),) * len(self.self_blocks),
            mask_BP.new_zeros(batch, 0),
            torch.zeros(batch, dtype=torch.int64, device=mask_BP.device),
            (),
            mask_BP,
        )


class Decoder(Trunk):
    """Alternates `CrossBlock` and `SelfBlock` over the history; the prompt stays as it is."""

    def __init__(self, config: DecoderConfig) -> None:
        super().__init__(config.width, config.num_layers, config.num_self_heads, config.dropout)
        self.prompt_positions = nn.Embedding(MAX_PROMPT_PLACES, config.width)
        self.cross_blocks = nn.ModuleList(CrossBlock(config) for _ in range(config.num_layers))
        normal_weights(self, config.initial_std)

    def begin(self, prompt_BPD: torch.Tensor, mask_BP: torch.Tensor) -> TrunkState:
        """Compute the keys and values of the prompt for every cross block."""
        _check_length(prompt_BPD.shape[1], MAX_PROMPT_PLACES, "the prompt")
        prompt_BPD = prompt_BPD + self.prompt_positions(position_ids(mask_BP))
        blocks = (cast(CrossBlock, block) for block in self.cross_blocks)
        prompt = tuple(block.keys_values(prompt_BPD) for block in blocks)
        return replace(self._nothing_read(prompt_BPD, mask_BP), prompt=prompt)

    def _condition(
        self, layer: int, x_ND: torch.Tensor, places: Places, state: TrunkState, seen_B11P: torch.Tensor
    ) -> torch.Tensor:
        return self.cross_blocks[layer](x_ND, places, state.prompt[layer], seen_B11P)


class PrefixTrunk(Trunk):
    """One causal sequence: prompt, a learned separator, history. The prompt does not see its own future."""

    sequence = "the sequence of prompt and history"

    def __init__(self, config: PrefixConfig) -> None:
        super().__init__(config.width, config.num_layers, config.num_heads, config.dropout)
        self.separator = nn.Parameter(torch.zeros(config.width))
        normal_weights(self, config.initial_std)

    def begin(self, prompt_BPD: torch.Tensor, mask_BP: torch.Tensor) -> TrunkState:
        """Run prompt and separator through the blocks."""
        _check_length(prompt_BPD.shape[1], MAX_PROMPT_PLACES, "the prompt")
        separator_B1D = self.separator.expand(len(prompt_BPD), 1, -1)
        tokens_BPD = torch.cat([prompt_BPD, separator_B1D], dim=1)
        mask_BP = F.pad(mask_BP, (0, 1), value=True)
        return self.extend(self._nothing_read(tokens_BPD, mask_BP), tokens_BPD, mask_BP)[1]


class CrossBlock(nn.Module):
    """Pre-norm attention to the prompt and a gated feed-forward; no linear has a bias.

    The gate reads the sum before its norm. That is how the published weights were trained.
    """

    def __init__(self, config: DecoderConfig) -> None:
        super().__init__()
        width = config.width
        self.num_heads = config.num_cross_heads
        self.norm_attention = nn.LayerNorm(width)
        self.query = Linear(width, width, bias=False)
        self.key_value = Linear(width, 2 * width, bias=False)
        self.attention_out = Linear(width, width, bias=False)
        self.norm_feed_forward = nn.LayerNorm(width)
        self.widen = Linear(width, 4 * width, bias=False)
        self.gate = Linear(width, 4 * width, bias=False)
        self.narrow = Linear(4 * width, width, bias=False)

    def keys_values(self, prompt_BPD: torch.Tensor) -> KeysValues:
        """Keys and values of the prompt; they stay the same through an episode."""
        # (B, P, 2·D) -> (2, B, H, P, K)
        key, value = self.key_value(prompt_BPD).unflatten(-1, (2, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        return key, value

    def forward(
        self, x_ND: torch.Tensor, places: Places, prompt: KeysValues, bias_B11P: torch.Tensor
    ) -> torch.Tensor:
        """Map packed places of the history to the same shape; `bias_B11P` hides prompt places."""
        query_BLD = places.unpack(self.query(self.norm_attention(x_ND)))
        query = query_BLD.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)
        mixed = F.scaled_dot_product_attention(query, *prompt, attn_mask=bias_B11P)
        attended = self.attention_out(places.pack(mixed.transpose(1, 2).flatten(2))) + x_ND
        hidden = F.gelu(self.widen(self.norm_feed_forward(attended))) * self.gate(attended)
        return self.narrow(hidden) + attended


class SelfBlock(nn.Module):
    """Post-norm causal self-attention and a gated feed-forward, in the manner of the first GPT."""

    def __init__(self, width: int, num_heads: int, dropout: float) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.attention_dropout = dropout
        self.query_key_value = Linear(width, 3 * width)
        self.attention_out = Linear(width, width)
        self.norm_attention = nn.LayerNorm(width)
        self.widen = Linear(width, 4 * width)
        self.gate = Linear(width, 4 * width, bias=False)
        self.narrow = Linear(4 * width, width)
        self.norm_feed_forward = nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self, x_ND: torch.Tensor, places: Places, past: KeysValues, bias_B1LS: torch.Tensor
    ) -> tuple[torch.Tensor, KeysValues]:
        """Map new places to the same shape.

        Args:
            x_ND: New places, packed.
            places: Where they stand.
            past: Keys and values of the places before them.
            bias_B1LS: Hides the future and masked places.

        Returns:
            Outputs, and keys and values of all places.
        """
        # (B, L, 3·D) -> (3, B, H, L, K)
        packed = places.unpack(self.query_key_value(x_ND)).unflatten(-1, (3, self.num_heads, -1))
        query, key, value = packed.permute(2, 0, 3, 1, 4)
        key, value = torch.cat([past[0], key], dim=2), torch.cat([past[1], value], dim=2)
        dropout = self.attention_dropout if self.training else 0.0
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=bias_B1LS, dropout_p=dropout)
        attended = self.dropout(self.attention_out(places.pack(mixed.transpose(1, 2).flatten(2))))
        attended = self.norm_attention(x_ND + attended)
        hidden = self.narrow(F.gelu(self.widen(attended)) * self.gate(attended))
        return self.norm_feed_forward(attended + self.dropout(hidden)), (key, value)


def build_trunk(config: DecoderConfig | PrefixConfig) -> Trunk:
    """Build the trunk that a config describes."""
    return Decoder(config) if isinstance(config, DecoderConfig) else PrefixTrunk(config)


def position_ids(mask_BL: torch.Tensor) -> torch.Tensor:
    """Number the valid places from 0; a masked place shares the number of the last valid one before it."""
    return (mask_BL.cumsum(dim=-1) - 1).clamp(min=0)


def score_bias(visible: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Bias for attention scores: 0 where visible, else the most negative number.

    It is finite on purpose: a row without any visible key then averages over all instead of giving NaN.
    """
    return torch.zeros(visible.shape, dtype=dtype, device=visible.device).masked_fill(
        ~visible, torch.finfo(dtype).min
    )


def _seen(past_BS: torch.Tensor, new_BL: torch.Tensor) -> torch.Tensor:
    """Which places each new place sees, shape (B, L, S + L)."""
    length = new_BL.shape[1]
    causal_LL = torch.ones(length, length, dtype=torch.bool, device=new_BL.device).tril()
    return torch.cat([past_BS[:, None, :].expand(-1, length, -1), causal_LL & new_BL[:, None, :]], dim=2)


def _check_length(length: int, limit: int, what: str) -> None:
    if length > limit:
        raise PolicyError(
            f"{what} has {length} tokens; this policy takes {limit}. Give a shorter prompt, fewer objects in "
            "view or fewer steps."
        )


def _check_sizes(what: str, width: int, heads: int, dropout: float) -> None:
    if heads < 1 or width % heads:
        raise ConfigError(f"{what}: width {width} must be a multiple of its {heads} heads.")
    if not 0 <= dropout < 1:
        raise ConfigError(f"{what}: dropout is {dropout}; it must lie in [0, 1).")
