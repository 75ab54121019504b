"""The prompt encoder: words and image tokens, interleaved, through a T5 encoder to the decoder's width.

The text encoder is that of T5: relative positions, RMSNorm, unscaled attention scores.

Shape suffixes: B batch, L prompt positions, N those of all prompts up to their ends, I image tokens of all
prompts, H heads, W width of the text encoder, K width of one head, D width of the decoder, E width of an
image token.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from openvima.policies.batch import PromptBatch
from openvima.policies.nn.layers import Linear, Unpadder, mlp

NUM_BUCKETS = 32  # half for keys before the query, half for keys after it
_NEIGHBOUR_BIAS = 5.0  # of scores: three of 60 positions get 88 % of the attention
_EXACT = 8  # distances below have a bucket each
_MAX_DISTANCE = 128


@dataclass(frozen=True, slots=True)
class TextEncoderConfig:
    """Sizes of the prompt encoder.

    Args:
        width: Width of word embeddings and tokens.
        num_layers: Blocks.
        num_heads: Attention heads in each.
        head_width: Width of one head; heads × head width need not be `width`.
        hidden_width: Inner width of the feed-forward parts.
    """

    width: int
    num_layers: int
    num_heads: int
    head_width: int
    hidden_width: int


class TextEncoder(nn.Module):
    """Blocks of attention and feed-forward with one shared table of relative-position biases."""

    def __init__(self, config: TextEncoderConfig) -> None:
        super().__init__()
        self.position_bias = nn.Embedding(NUM_BUCKETS, config.num_heads)
        self.blocks = nn.ModuleList(TextBlock(config) for _ in range(config.num_layers))
        self.norm_after = RmsNorm(config.width)
        nn.init.normal_(self.position_bias.weight, std=config.width**-0.5)

    @torch.no_grad()
    def align(self) -> None:
        """Let fresh attention of one head begin at the three positions before, of another at those behind.

        Otherwise attention stays a mean of the whole prompt, and which of two images comes first is learned
        from the decoder's absolute positions alone; see results/2026-11-29_prompt_positions.md.
        """
        for head, first in ((0, 1), (1, NUM_BUCKETS // 2 + 1)):
            self.position_bias.weight[first : first + 3, head] += _NEIGHBOUR_BIAS

    def forward(self, tokens_BLW: torch.Tensor, mask_BL: torch.Tensor) -> torch.Tensor:
        """Encode the sequence with full attention to valid positions.

        Args:
            tokens_BLW: Word embeddings and image tokens, shape (B, L, W).
            mask_BL: Which positions are valid, shape (B, L), bool.

        Returns:
            Shape (B, L, W); masked positions are finite and carry no meaning. Padding after the last valid
            position is not computed and zero.
        """
        unpadder = Unpadder(mask_BL.flip(1).cumsum(dim=1).flip(1) > 0)
        numbers_L = torch.arange(tokens_BLW.shape[1], device=tokens_BLW.device)
        buckets_LL = relative_bucket(numbers_L[None, :] - numbers_L[:, None])
        bias_HLL = self.position_bias(buckets_LL).permute(2, 0, 1)
        hidden = torch.finfo(tokens_BLW.dtype).min
        bias_BHLL = bias_HLL.masked_fill(~mask_BL[:, None, None, :], hidden)
        x_NW = unpadder.unpad(tokens_BLW)
        for block in self.blocks:
            x_NW = block(x_NW, unpadder, bias_BHLL)
        return unpadder.pad(self.norm_after(x_NW))


class TextBlock(nn.Module):
    """One block: `x += attention(norm(x))`, then `x += feed_forward(norm(x))`, without any bias."""

    def __init__(self, config: TextEncoderConfig) -> None:
        super().__init__()
        inner = config.num_heads * config.head_width
        self.num_heads = config.num_heads
        self.norm_attention = RmsNorm(config.width)
        self.query = Linear(config.width, inner, bias=False)
        self.key = Linear(config.width, inner, bias=False)
        self.value = Linear(config.width, inner, bias=False)
        self.attention_out = Linear(inner, config.width, bias=False)
        self.norm_feed_forward = RmsNorm(config.width)
        self.widen = Linear(config.width, config.hidden_width, bias=False)
        self.narrow = Linear(config.hidden_width, config.width, bias=False)
        # Scores are not divided by √K; the smaller start of the queries stands in for it, as in T5.
        nn.init.normal_(self.query.weight, std=(config.width * config.head_width) ** -0.5)
        for linear in (self.key, self.value):
            nn.init.normal_(linear.weight, std=config.width**-0.5)

    def forward(self, x_NW: torch.Tensor, unpadder: Unpadder, bias_BHLL: torch.Tensor) -> torch.Tensor:
        """Map unpadded tokens to the same shape; `bias_BHLL` is added to the attention scores."""
        normed = self.norm_attention(x_NW)
        query, key, value = (
            unpadder.pad(linear(normed)).unflatten(-1, (self.num_heads, -1)).transpose(1, 2)  # (B, H, L, K)
            for linear in (self.query, self.key, self.value)
        )
        mixed = torch.softmax(query @ key.mT + bias_BHLL, dim=-1) @ value
        x_NW = x_NW + self.attention_out(unpadder.unpad(mixed.transpose(1, 2).flatten(2)))
        return x_NW + self.narrow(torch.relu(self.widen(self.norm_feed_forward(x_NW))))


class RmsNorm(nn.Module):
    """RMSNorm: division by the root mean square, and a weight per channel.

    Squares are computed in float32 at least: in half precision they overflow or lose most of their digits.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalise the last axis; the result has the precision of `x`."""
        wide = x.to(torch.promote_types(x.dtype, torch.float32))
        scale = torch.rsqrt(wide.square().mean(-1, keepdim=True) + 1e-6)
        return (wide * scale).to(x.dtype) * self.weight


def relative_bucket(offset: torch.Tensor) -> torch.Tensor:
    """Bucket of a key that is `offset` positions after the query (before it, if negative).

    Distances below 8 have a bucket each, larger ones share logarithmic buckets, separately on both sides.

    Source: "Exploring the Limits of Transfer Learning", T5; the logarithm is taken in float32 as there.
    """
    side = NUM_BUCKETS // 2
    distance = offset.abs()
    ratio = distance.clamp(min=1).to(torch.float32) / _EXACT
    far = _EXACT + (torch.log(ratio) / math.log(_MAX_DISTANCE / _EXACT) * (side - _EXACT)).to(torch.int64)
    bucket = torch.where(distance < _EXACT, distance, far.clamp(max=side - 1))
    return bucket + side * (offset > 0)


@dataclass(frozen=True, slots=True)
class PromptEncoderConfig:
    """Config of the prompt encoder.

    Args:
        text: The text encoder.
        image_width: Hidden width of the MLP that projects image tokens into the prompt.
        vocabulary_size: Number of word embeddings; those behind the vocabulary are its reserve.
        tokenizer: "words", a vocabulary that is stored with the policy; or "t5", which needs the files of the
            tokenizer.
        train_words: Whether the word embedding is trained.
        trained_layers: How many of the last layers of the text encoder are trained, with its final norm; 0
            freezes it. None trains all of it, position biases included.
        visual_residual: Add the input of the text encoder to its output at image tokens (MIDAS).
    """

    text: TextEncoderConfig
    image_width: int
    vocabulary_size: int
    tokenizer: Literal["words", "t5"] = "words"
    train_words: bool = True
    trained_layers: int | None = None
    visual_residual: bool = False


class PromptEncoder(nn.Module):
    """Words and image tokens -> one sequence -> text encoder -> linear layer to the decoder's width.

    "Put the {a} into the {b}." with one object in each image:

        [put, the, A, into, the, B, ., end]
    """

    def __init__(self, config: PromptEncoderConfig, *, image_token_width: int, width: int) -> None:
        super().__init__()
        words = config.text.width
        self.words = nn.Embedding(config.vocabulary_size, words)
        self.images = mlp((image_token_width, config.image_width, config.image_width, words))
        self.text = TextEncoder(config.text)
        self.visual_residual = config.visual_residual
        # The published 768-wide policies have no layer here, since both widths are equal.
        self.out = nn.Identity() if words == width else nn.Linear(words, width, bias=False)
        self.words.requires_grad_(config.train_words)
        if config.trained_layers is not None:
            self.text.requires_grad_(False)
            if config.trained_layers:
                self.text.blocks[-config.trained_layers :].requires_grad_(True)
                self.text.norm_after.requires_grad_(True)

    def forward(self, prompts: PromptBatch, image_tokens_IE: torch.Tensor) -> torch.Tensor:
        """Encode prompts.

        Args:
            prompts: Word ids and positions of image tokens.
            image_tokens_IE: Image tokens.

        Returns:
            Shape (B, L, D); masked positions are finite and carry no meaning.
        """
        tokens_BLW, images_BLW = self.embed(prompts, image_tokens_IE)
        return self.encode(tokens_BLW, images_BLW, prompts.mask_BL)

    def embed(self, prompts: PromptBatch, image_tokens_IE: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Embed words and images: the input of the text encoder, and its image part alone, (B, L, W)."""
        words_BLW = self.words(prompts.word_ids_BL)
        if not len(image_tokens_IE):
            return words_BLW, torch.zeros_like(words_BLW)
        is_image_BL1 = (prompts.object_index_BL >= 0)[..., None]
        images_BLW = self.images(image_tokens_IE)[prompts.object_index_BL.clamp(min=0)] * is_image_BL1
        return torch.where(is_image_BL1, images_BLW, words_BLW), images_BLW

    def encode(
        self, tokens_BLW: torch.Tensor, images_BLW: torch.Tensor, mask_BL: torch.Tensor
    ) -> torch.Tensor:
        """Run the text encoder on the output of `embed`, (B, L, D)."""
        encoded_BLW = self.text(tokens_BLW, mask_BL)
        return self.out(encoded_BLW + images_BLW if self.visual_residual else encoded_BLW)
