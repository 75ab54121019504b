"""The two decoders of a history, given a prompt, with key-value caches.

`Decoder` attends to the prompt through cross-attention (by default VIMA, VIMA-Flamingo, nano, small).
`PrefixDecoder` puts the prompt before the history in one causal sequence (VIMA-Gato, VIMA-GPT, MIDAS).
Training decodes a whole history in one call, acting one step per call: both run the same code on the same
cache.

Shape suffixes: B batch, T steps, Q tokens of a step, L new positions, N valid positions of all rows, S cached
positions, P positions of the prompt, D width, H heads, K width of a head.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from openvima.errors import ConfigError, PolicyError
from openvima.policies.nn.layers import Linear, TensorRecord, Unpadder, normal_weights, valid_first

MAX_POSITIONS = 512  # of the history; with a prefix, of prompt and history together
MAX_PROMPT_POSITIONS = 256
OBSERVATION_MARK = 4.0  # first channel of fresh observation tokens; the others are of the order of 1
_MARK_GAIN = 3.0  # lowers a score by 3 · 3 · 4 / √(width of a head), 6 nats
_POSITION_GAIN = 4.0  # of position embeddings, which are added to tokens of the order of 1

KeysValues = tuple[torch.Tensor, torch.Tensor]  # (B, H, S, K) each


@dataclass(frozen=True, slots=True)
class DecoderConfig:
    """Sizes of the decoder with cross-attention.

    Args:
        width: Width of its tokens.
        num_layers: Pairs of a cross block and a self block.
        num_self_heads: Heads of self-attention.
        num_cross_heads: Heads of cross-attention.
        dropout: Dropout probability in self blocks and after the position embedding.
        initial_std: Standard deviation of fresh weights.
    """

    width: int
    num_layers: int
    num_self_heads: int
    num_cross_heads: int
    dropout: float = 0.1
    initial_std: float = 0.02

    def __post_init__(self) -> None:
        _check_heads(self.width, self.num_self_heads)
        _check_heads(self.width, self.num_cross_heads)

    @property
    def num_heads(self) -> int:
        """Heads of self-attention."""
        return self.num_self_heads


@dataclass(frozen=True, slots=True)
class PrefixDecoderConfig:
    """Sizes of the decoder that has the prompt as its prefix.

    Args:
        width: Width of its tokens.
        num_layers: Self blocks.
        num_heads: Heads of each.
        dropout: Dropout probability in the blocks and after the position embedding.
        initial_std: Standard deviation of fresh weights.
    """

    width: int
    num_layers: int
    num_heads: int
    dropout: float = 0.1
    initial_std: float = 0.02

    def __post_init__(self) -> None:
        _check_heads(self.width, self.num_heads)


AnyDecoderConfig = DecoderConfig | PrefixDecoderConfig


@dataclass(frozen=True, slots=True, eq=False)
class KVCache(TensorRecord):
    """Keys and values of everything decoded so far.

    Args:
        past: Keys and values of each self block.
        mask_BS: Which cached positions may be attended to; their number is the next valid token's position.
        prompt: Keys and values of each cross block; empty with a prefix.
        prompt_mask_BP: Which positions of the prompt may be attended to.
        first: Tokens and table points of the objects at the first step, if positions are read from objects.
    """

    past: tuple[KeysValues, ...]
    mask_BS: torch.Tensor
    prompt: tuple[KeysValues, ...]
    prompt_mask_BP: torch.Tensor
    first: tuple[torch.Tensor, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class TokenSegment:
    """Tokens of every step that are adjacent in the sequence, such as its observation or its action.

    Args:
        tokens_BTQD: The tokens.
        mask_BTQ: Which of them may be attended to.
        valid_BTQ: Which of them get an output: those of the mask, and padding that the action is read from.
    """

    tokens_BTQD: torch.Tensor
    mask_BTQ: torch.Tensor
    valid_BTQ: torch.Tensor


class CausalDecoder(nn.Module):
    """What both decoders share: position embedding, self blocks, the cache."""

    sequence_name = "the history"  # what the position table covers
    self_blocks: Any  # a list of `SelfBlock`
    cross_blocks: Any  # a list of `CrossBlock`, only of `Decoder`

    def __init__(self, config: AnyDecoderConfig) -> None:
        super().__init__()
        self.width, self.num_heads = config.width, config.num_heads
        self.positions = nn.Embedding(MAX_POSITIONS, self.width)
        self.self_blocks = nn.ModuleList(SelfBlock(config) for _ in range(config.num_layers))
        self.dropout = nn.Dropout(config.dropout)

    def forward(
        self,
        cache: KVCache,
        tokens_BLD: torch.Tensor,
        mask_BL: torch.Tensor,
        valid_BL: torch.Tensor | None = None,
        *,
        only_cache: bool = False,
    ) -> tuple[torch.Tensor, KVCache]:
        """Decode the next tokens.

        Args:
            cache: What was decoded before.
            tokens_BLD: Tokens in temporal order.
            mask_BL: Which of them may be attended to, bool. Masked tokens still get an output.
            valid_BL: Which get an output, bool, those of the mask among them; all by default.
            only_cache: Leave out the last block but for its keys and values; the outputs mean nothing then.

        Returns:
            Outputs, shape (B, L, D), zero where not valid, and the cache after them. A token attends to the
            unmasked ones before it, and to itself if unmasked. Decoding in pieces equals decoding at once up
            to rounding.

        Raises:
            PolicyError: The history is longer than the position table.
        """
        mask_BS, num_past = torch.cat([cache.mask_BS, mask_BL], dim=1), cache.mask_BS.shape[1]
        positions_BS = position_ids(mask_BS)
        if mask_BS.shape[1] > MAX_POSITIONS:  # only then synchronise
            check_length(int(positions_BS.max()) + 1, MAX_POSITIONS, self.sequence_name)
        unpadder = Unpadder(torch.ones_like(mask_BL) if valid_BL is None else valid_BL)
        x_ND = self.dropout(unpadder.unpad(tokens_BLD + self.positions(positions_BS[:, num_past:])))
        causal_LS = torch.ones_like(mask_BS[0]).expand(mask_BL.shape[1], -1).tril(num_past)
        self_bias_B1LS = attention_bias((causal_LS & mask_BS[:, None])[:, None], x_ND.dtype)
        prompt_bias_B11P = attention_bias(cache.prompt_mask_BP[:, None, None, :], x_ND.dtype)
        past = []
        for layer, block in enumerate(self.self_blocks):
            if cache.prompt:
                x_ND = self.cross_blocks[layer](x_ND, unpadder, cache.prompt[layer], prompt_bias_B11P)
            if only_cache and layer == len(self.self_blocks) - 1:
                past.append(block.project(x_ND, unpadder, cache.past[layer])[1:])
                break
            x_ND, keys_values = block(x_ND, unpadder, cache.past[layer], self_bias_B1LS)
            past.append(keys_values)
        return unpadder.pad(x_ND), replace(cache, past=tuple(past), mask_BS=mask_BS)

    def decode_segments(
        self, cache: KVCache, segments: Sequence[TokenSegment]
    ) -> tuple[tuple[torch.Tensor, ...], KVCache]:
        """Decode steps of several segments each: all segments of a step, then those of the next.

        Padding within the steps is removed before decoding.

        Returns:
            The outputs of each segment, (B, T, Q, D), zero where not valid; and the cache.
        """
        sizes = [segment.tokens_BTQD.shape[2] for segment in segments]
        sequence_BLD, mask_BL, valid_BL = (
            torch.cat([getattr(segment, name) for segment in segments], dim=2).flatten(1, 2)
            for name in ("tokens_BTQD", "mask_BTQ", "valid_BTQ")
        )
        if valid_BL.all():  # as where a single episode acts
            outputs_BLD, cache = self(cache, sequence_BLD, mask_BL)
        else:
            # Valid tokens move to the front of each row, in their order, and their outputs back: the sequence
            # is then as long as the longest episode, not as all slots together. Rows stay padded, hence
            # `valid` once more.
            order_BP = valid_first(valid_BL)
            index_BPD = order_BP[..., None].expand(-1, -1, sequence_BLD.shape[-1])
            masks = (mask_BL.gather(1, order_BP), valid_BL.gather(1, order_BP))
            outputs_BPD, cache = self(cache, sequence_BLD.gather(1, index_BPD), *masks)
            outputs_BLD = outputs_BPD.new_zeros(sequence_BLD.shape).scatter(1, index_BPD, outputs_BPD)
        return outputs_BLD.unflatten(1, (-1, sum(sizes))).split(sizes, dim=2), cache

    def _empty_cache(self, prompt_BPD: torch.Tensor, mask_BP: torch.Tensor) -> KVCache:
        batch = len(prompt_BPD)
        empty = prompt_BPD.new_zeros(batch, self.num_heads, 0, self.width // self.num_heads)
        past = ((empty, empty),) * len(self.self_blocks)
        return KVCache(past, mask_BP.new_zeros(batch, 0), (), mask_BP)


class Decoder(CausalDecoder):
    """Alternates cross blocks and self blocks over the history; the prompt is not transformed."""

    def __init__(self, config: DecoderConfig) -> None:
        super().__init__(config)
        self.prompt_positions = nn.Embedding(MAX_PROMPT_POSITIONS, config.width)
        self.cross_blocks = nn.ModuleList(CrossBlock(config) for _ in range(config.num_layers))
        normal_weights(self, config.initial_std)

    def init_cache(self, prompt_BPD: torch.Tensor, mask_BP: torch.Tensor) -> KVCache:
        """Compute the keys and values of the prompt for every cross block; once per episode.

        Args:
            prompt_BPD: Encoded prompt.
            mask_BP: Which of its positions are valid, bool.

        Raises:
            PolicyError: The prompt is longer than the position table.
        """
        check_length(prompt_BPD.shape[1], MAX_PROMPT_POSITIONS, "the prompt")
        prompt_BPD = prompt_BPD + self.prompt_positions(position_ids(mask_BP))
        prompt = tuple(block.keys_values(prompt_BPD) for block in self.cross_blocks)
        return replace(self._empty_cache(prompt_BPD, mask_BP), prompt=prompt)

    def align(self) -> None:
        """Let fresh attention to the prompt compare queries and keys by one matrix, in every cross block.

        Positions start as in `PrefixDecoder.align`.
        """
        self.positions.weight.mul_(_POSITION_GAIN)
        self.prompt_positions.weight.mul_(_POSITION_GAIN)
        for block in self.cross_blocks:
            _align(block.query.weight, block.key_value.weight[: self.width])


class PrefixDecoder(CausalDecoder):
    """One causal sequence: prompt, a learned separator, history."""

    sequence_name = "the sequence of prompt and history"

    def __init__(self, config: PrefixDecoderConfig) -> None:
        super().__init__(config)
        self.separator = nn.Parameter(torch.zeros(config.width))
        normal_weights(self, config.initial_std)

    def init_cache(self, prompt_BPD: torch.Tensor, mask_BP: torch.Tensor) -> KVCache:
        """Decode prompt and separator; the prompt is causal as well. See `Decoder.init_cache`."""
        check_length(prompt_BPD.shape[1], MAX_PROMPT_POSITIONS, "the prompt")
        separator_B1D = self.separator.expand(len(prompt_BPD), 1, -1)
        tokens_BPD = torch.cat([prompt_BPD, separator_B1D], dim=1)
        mask_BP = F.pad(mask_BP, (0, 1), value=True)
        # Nothing attends to what is masked, most of it padding, so none of it is computed.
        return self(self._empty_cache(tokens_BPD, mask_BP), tokens_BPD, mask_BP, mask_BP, only_cache=True)[1]

    def align(self) -> None:
        """Do as `Decoder.align` in half of the heads of the first block.

        Their attention reaches the history as well, where objects are most like themselves, and training
        forgets the prompt within 300 steps. So the first channel of these heads lowers the score of tokens
        with `OBSERVATION_MARK` in their own first channel.

        Positions start as strong as the tokens that they are added to: small ones are inaudible beside image
        tokens, which grow in training. See results/2026-11-29_positions.md.
        """
        self.positions.weight.mul_(_POSITION_GAIN)
        block = self.self_blocks[0]
        head_width = self.width // self.num_heads
        aligned = -(-self.num_heads // 2) * head_width
        query_DD, key_DD, _ = block.query_key_value.weight.split(self.width)
        _align(query_DD[:aligned], key_DD[:aligned])
        first = slice(0, aligned, head_width)
        query_DD[first], key_DD[first] = 0, 0
        block.query_key_value.bias[first] = _MARK_GAIN
        key_DD[first, 0] = -_MARK_GAIN


def build_decoder(config: AnyDecoderConfig) -> Decoder | PrefixDecoder:
    """Build the decoder of a config."""
    return Decoder(config) if isinstance(config, DecoderConfig) else PrefixDecoder(config)


class CrossBlock(nn.Module):
    """Pre-norm attention to the prompt and a gated feed-forward; no linear has a bias.

    The gate reads the sum before its norm, as the published weights were trained.
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
        """Compute keys and values of the prompt; they do not change within an episode."""
        # (B, P, 2·D) -> (2, B, H, P, K)
        key, value = self.key_value(prompt_BPD).unflatten(-1, (2, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        return key, value

    def forward(
        self, x_ND: torch.Tensor, unpadder: Unpadder, prompt: KeysValues, bias_B11P: torch.Tensor
    ) -> torch.Tensor:
        """Map unpadded tokens to the same shape; `bias_B11P` masks the prompt."""
        query, key, value = self.project(x_ND, unpadder, prompt)
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=bias_B11P)
        attended = self.attention_out(unpadder.unpad(mixed.transpose(1, 2).flatten(2))) + x_ND
        hidden = F.gelu(self.widen(self.norm_feed_forward(attended))) * self.gate(attended)
        return self.narrow(hidden) + attended

    def project(
        self, x_ND: torch.Tensor, unpadder: Unpadder, prompt: KeysValues
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the queries of unpadded tokens, (B, H, L, K), and the keys and values of the prompt."""
        query_BLD = unpadder.pad(self.query(self.norm_attention(x_ND)))
        return query_BLD.unflatten(-1, (self.num_heads, -1)).transpose(1, 2), *prompt


class SelfBlock(nn.Module):
    """Post-norm causal self-attention and a gated feed-forward, as in the first GPT."""

    def __init__(self, config: AnyDecoderConfig) -> None:
        super().__init__()
        width, self.num_heads = config.width, config.num_heads
        self.query_key_value = Linear(width, 3 * width)
        self.attention_out = Linear(width, width)
        self.norm_attention = nn.LayerNorm(width)
        self.widen = Linear(width, 4 * width)
        self.gate = Linear(width, 4 * width, bias=False)
        self.narrow = Linear(4 * width, width)
        self.norm_feed_forward = nn.LayerNorm(width)
        self.dropout = nn.Dropout(config.dropout)

    def forward(
        self, x_ND: torch.Tensor, unpadder: Unpadder, past: KeysValues, bias_B1LS: torch.Tensor
    ) -> tuple[torch.Tensor, KeysValues]:
        """Map new tokens to the same shape.

        Args:
            x_ND: New tokens, unpadded.
            unpadder: Their positions.
            past: Cached keys and values.
            bias_B1LS: Masks the future and masked positions.

        Returns:
            Outputs, and the keys and values of all positions.
        """
        query, key, value = self.project(x_ND, unpadder, past)
        dropout = self.dropout.p if self.training else 0.0
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=bias_B1LS, dropout_p=dropout)
        attended = self.dropout(self.attention_out(unpadder.unpad(mixed.transpose(1, 2).flatten(2))))
        attended = self.norm_attention(x_ND + attended)
        hidden = self.narrow(F.gelu(self.widen(attended)) * self.gate(attended))
        return self.norm_feed_forward(attended + self.dropout(hidden)), (key, value)

    def project(
        self, x_ND: torch.Tensor, unpadder: Unpadder, past: KeysValues
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the queries of new tokens, and the keys and values of all."""
        # (B, L, 3·D) -> (3, B, H, L, K)
        padded = unpadder.pad(self.query_key_value(x_ND)).unflatten(-1, (3, self.num_heads, -1))
        query, key, value = padded.permute(2, 0, 3, 1, 4)
        return query, torch.cat([past[0], key], dim=2), torch.cat([past[1], value], dim=2)


def last_attention(
    block: Any,  # a block of either kind, called with the rest
    x_ND: torch.Tensor,
    unpadder: Unpadder,
    keys_values: KeysValues,
    bias_B1LS: torch.Tensor,
) -> torch.Tensor:
    """Return the weights with which a block attends from the last token of each row, (B, H, S)."""
    query_BHLK, key_BHSK, _ = block.project(x_ND, unpadder, keys_values)
    last_B = unpadder.pad(torch.ones_like(x_ND[..., 0, None]))[..., 0].sum(dim=1).to(torch.int64) - 1
    rows_B = torch.arange(len(last_B), device=last_B.device)
    query_BHK = query_BHLK[rows_B, :, last_B]
    bias_B1S = bias_B1LS.expand(-1, -1, query_BHLK.shape[2], -1)[rows_B, :, last_B]
    scores_BHS = (query_BHK[..., None, :] @ key_BHSK.mT).squeeze(-2) * query_BHK.shape[-1] ** -0.5
    return torch.softmax(scores_BHS + bias_B1S, dim=-1)


def _align(query_DD: torch.Tensor, key_DD: torch.Tensor) -> None:
    nn.init.orthogonal_(query_DD)
    key_DD.copy_(query_DD)


def position_ids(mask_BL: torch.Tensor) -> torch.Tensor:
    """Number the valid positions from 0; a masked one shares the number of the last valid one before it."""
    return (mask_BL.cumsum(dim=-1) - 1).clamp(min=0)


def attention_bias(visible: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Additive attention mask: 0 where visible, else the most negative finite number.

    It is finite so that a row without visible keys averages over all of them instead of giving NaN.
    """
    return torch.zeros(visible.shape, dtype=dtype, device=visible.device).masked_fill(
        ~visible, torch.finfo(dtype).min
    )


def check_length(length: int, limit: int, what: str) -> None:
    """Raise a PolicyError if a sequence has more tokens than the policy takes."""
    if length > limit:
        raise PolicyError(
            f"{what} has {length} tokens; this policy takes {limit}. Give a shorter prompt, fewer objects in "
            "view or fewer steps."
        )


def _check_heads(width: int, heads: int) -> None:
    if heads < 1 or width % heads:
        raise ConfigError(f"decoder: width {width} must be a multiple of its {heads} heads.")
