"""The decoder: blocks of cross-attention to the prompt and causal self-attention over the history.

Shape suffixes: B batch, L places of the history, P places of the prompt, D width, H heads, K width of a head.
"""

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.errors import ConfigError, PolicyError

MAX_PLACES = 512  # of the history
MAX_PROMPT_PLACES = 256


@dataclass(frozen=True, slots=True)
class DecoderConfig:
    """Sizes of the decoder.

    Args:
        width: Width of its tokens.
        num_layers: Pairs of a cross block and a self block.
        num_self_heads: Heads of self-attention.
        num_cross_heads: Heads of cross-attention.
        dropout: Share of values dropped in training, in self blocks and after the position embedding.
    """

    width: int
    num_layers: int
    num_self_heads: int
    num_cross_heads: int
    dropout: float = 0.1

    def __post_init__(self) -> None:
        for name, heads in (("self", self.num_self_heads), ("cross", self.num_cross_heads)):
            if heads < 1 or self.width % heads:
                raise ConfigError(f"decoder: width {self.width} must be a multiple of {heads} {name} heads.")
        if not 0 <= self.dropout < 1:
            raise ConfigError(f"decoder: dropout is {self.dropout}; it must lie in [0, 1).")


class Decoder(nn.Module):
    """Alternates `CrossBlock` and `SelfBlock` over the history; the prompt stays as it is."""

    def __init__(self, config: DecoderConfig) -> None:
        super().__init__()
        self.positions = nn.Embedding(MAX_PLACES, config.width)
        self.prompt_positions = nn.Embedding(MAX_PROMPT_PLACES, config.width)
        self.cross_blocks = nn.ModuleList(CrossBlock(config) for _ in range(config.num_layers))
        self.self_blocks = nn.ModuleList(SelfBlock(config) for _ in range(config.num_layers))
        self.dropout = nn.Dropout(config.dropout)
        for module in self.modules():
            if isinstance(module, nn.Linear | nn.Embedding):
                nn.init.normal_(module.weight, std=0.02)
            if isinstance(module, nn.Linear) and module.bias is not None:
                nn.init.zeros_(module.bias)

    def forward(
        self,
        tokens_BLD: torch.Tensor,
        mask_BL: torch.Tensor,
        *,
        prompt_BPD: torch.Tensor,
        prompt_mask_BP: torch.Tensor,
    ) -> torch.Tensor:
        """Decode a history.

        Args:
            tokens_BLD: Objects and actions in the order of time.
            mask_BL: Which places may be looked at, bool. Masked places still get an output.
            prompt_BPD: Encoded prompt.
            prompt_mask_BP: Which of its places are valid, bool.

        Returns:
            Shape (B, L, D). A place sees itself and the valid places before it.

        Raises:
            PolicyError: The history or the prompt has more places than the position tables.
        """
        _check_length(tokens_BLD.shape[1], MAX_PLACES, "the history")
        _check_length(prompt_BPD.shape[1], MAX_PROMPT_PLACES, "the prompt")
        x_BLD = self.dropout(tokens_BLD + self.positions(position_ids(mask_BL)))
        prompt_BPD = prompt_BPD + self.prompt_positions(position_ids(prompt_mask_BP))
        causal_LL = torch.ones(x_BLD.shape[1], x_BLD.shape[1], dtype=torch.bool, device=mask_BL.device).tril()
        seen_B1LL = score_bias(causal_LL & mask_BL[:, None, None, :], x_BLD.dtype)
        seen_B11P = score_bias(prompt_mask_BP[:, None, None, :], x_BLD.dtype)
        for cross_block, self_block in zip(self.cross_blocks, self.self_blocks, strict=True):
            x_BLD = self_block(cross_block(x_BLD, prompt_BPD, seen_B11P), seen_B1LL)
        return x_BLD


class CrossBlock(nn.Module):
    """Pre-norm attention to the prompt and a gated feed-forward; no linear has a bias.

    The gate reads the sum before its norm. That is how the published weights were trained.
    """

    def __init__(self, config: DecoderConfig) -> None:
        super().__init__()
        width = config.width
        self.num_heads = config.num_cross_heads
        self.norm_attention = nn.LayerNorm(width)
        self.query = nn.Linear(width, width, bias=False)
        self.key_value = nn.Linear(width, 2 * width, bias=False)
        self.attention_out = nn.Linear(width, width, bias=False)
        self.norm_feed_forward = nn.LayerNorm(width)
        self.widen = nn.Linear(width, 4 * width, bias=False)
        self.gate = nn.Linear(width, 4 * width, bias=False)
        self.narrow = nn.Linear(4 * width, width, bias=False)

    def forward(self, x_BLD: torch.Tensor, prompt_BPD: torch.Tensor, bias_B11P: torch.Tensor) -> torch.Tensor:
        """Map the history to the same shape; `bias_B11P` hides prompt places."""
        query = self.query(self.norm_attention(x_BLD)).unflatten(-1, (self.num_heads, -1)).transpose(1, 2)
        # (B, P, 2·D) -> (2, B, H, P, K)
        key, value = self.key_value(prompt_BPD).unflatten(-1, (2, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=bias_B11P)
        attended = self.attention_out(mixed.transpose(1, 2).flatten(2)) + x_BLD
        hidden = F.gelu(self.widen(self.norm_feed_forward(attended))) * self.gate(attended)
        return self.narrow(hidden) + attended


class SelfBlock(nn.Module):
    """Post-norm causal self-attention and a gated feed-forward, in the manner of the first GPT."""

    def __init__(self, config: DecoderConfig) -> None:
        super().__init__()
        width = config.width
        self.num_heads = config.num_self_heads
        self.attention_dropout = config.dropout
        self.query_key_value = nn.Linear(width, 3 * width)
        self.attention_out = nn.Linear(width, width)
        self.norm_attention = nn.LayerNorm(width)
        self.widen = nn.Linear(width, 4 * width)
        self.gate = nn.Linear(width, 4 * width, bias=False)
        self.narrow = nn.Linear(4 * width, width)
        self.norm_feed_forward = nn.LayerNorm(width)
        self.dropout = nn.Dropout(config.dropout)

    def forward(self, x_BLD: torch.Tensor, bias_B1LL: torch.Tensor) -> torch.Tensor:
        """Map the history to the same shape; `bias_B1LL` hides the future and masked places."""
        # (B, L, 3·D) -> (3, B, H, L, K)
        packed = self.query_key_value(x_BLD).unflatten(-1, (3, self.num_heads, -1))
        query, key, value = packed.permute(2, 0, 3, 1, 4)
        dropout = self.attention_dropout if self.training else 0.0
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=bias_B1LL, dropout_p=dropout)
        attended = self.dropout(self.attention_out(mixed.transpose(1, 2).flatten(2)))
        attended = self.norm_attention(x_BLD + attended)
        hidden = self.narrow(F.gelu(self.widen(attended)) * self.gate(attended))
        return self.norm_feed_forward(attended + self.dropout(hidden))


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


def _check_length(length: int, limit: int, what: str) -> None:
    if length > limit:
        raise PolicyError(f"{what} has {length} tokens; this policy takes {limit}. Shorten it.")
