"""The prompt encoder: words and image tokens, interleaved, through a T5 encoder into the trunk's width.

Shape suffixes: B batch, L prompt places, I image tokens of all prompts, W width of the text encoder, D width
of the trunk, E width of an image token.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from openvima.errors import ConfigError
from openvima.policies.nn.mlp import mlp
from openvima.policies.nn.text_encoder import TextEncoder, TextEncoderConfig


@dataclass(frozen=True, slots=True)
class PromptEncoderConfig:
    """Sizes of the prompt encoder, and what of it is trained.

    Args:
        text: The text encoder.
        image_width: Hidden width of the stack that takes image tokens into the prompt.
        vocabulary_size: Number of word ids.
        tokenizer: "closed", the benchmark's own vocabulary; or "t5", that of T5, which needs its files.
        train_words: Whether the word embedding is trained.
        trained_layers: How many of the last layers of the text encoder are trained, with its last norm; 0 for
            a frozen one. None trains all of it, position biases included.
        visual_residual: Add what goes into the text encoder for an image to what comes out at that place, so
            that what an object looks like reaches the trunk even through a text encoder that knows words.
        referents: Words bring along the pictures that stood behind the same word before: "This is a wug
            {image}. Put the wug …"
    """

    text: TextEncoderConfig
    image_width: int
    vocabulary_size: int
    tokenizer: Literal["closed", "t5"] = "closed"
    train_words: bool = True
    trained_layers: int | None = None
    visual_residual: bool = False
    referents: bool = False

    def __post_init__(self) -> None:
        if self.tokenizer not in ("closed", "t5"):
            raise ConfigError(f"prompt encoder: tokenizer is {self.tokenizer!r}; allowed: 'closed', 't5'.")
        layers = self.text.num_layers
        if self.trained_layers is not None and not 0 <= self.trained_layers <= layers:
            raise ConfigError(
                f"prompt encoder: trained_layers is {self.trained_layers}; it must be between 0 and {layers}."
            )


class PromptEncoder(nn.Module):
    """Words and image tokens -> one sequence -> text encoder -> linear layer to the trunk's width.

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
        # How much a word stands for its picture.
        self.refers = nn.Linear(words, 1) if config.referents else None
        # The published 768-wide policies have no layer here, since both widths are equal.
        self.out = nn.Identity() if words == width else nn.Linear(words, width, bias=False)
        self._freeze(config)

    def forward(
        self,
        word_ids_BL: torch.Tensor,
        object_index_BL: torch.Tensor,
        mask_BL: torch.Tensor,
        image_tokens_IE: torch.Tensor,
        refers_BLL: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Encode prompts.

        Args:
            word_ids_BL: Word ids.
            object_index_BL: Row of the image token that stands at a place; negative where a word stands.
            mask_BL: Which places are valid.
            image_tokens_IE: Image tokens.
            refers_BLL: Which places each word refers to, see `referents`; only where words bring along
                pictures.

        Returns:
            Shape (B, L, D); masked places are finite and mean nothing.
        """
        tokens_BLW = self.words(word_ids_BL)
        if not len(image_tokens_IE):
            return self.out(self.text(tokens_BLW, mask_BL))
        is_image_BL1 = (object_index_BL >= 0)[..., None]
        chosen_BLW = self.images(image_tokens_IE)[object_index_BL.clamp(min=0)]
        tokens_BLW = torch.where(is_image_BL1, chosen_BLW, tokens_BLW)
        if self.refers is not None and refers_BLL is not None:
            brought_BLW = refers_BLL @ chosen_BLW
            tokens_BLW = tokens_BLW + torch.sigmoid(self.refers(tokens_BLW)) * brought_BLW
        encoded_BLW = self.text(tokens_BLW, mask_BL)
        if self.visual_residual:
            encoded_BLW = encoded_BLW + chosen_BLW * is_image_BL1
        return self.out(encoded_BLW)

    def _freeze(self, config: PromptEncoderConfig) -> None:
        self.words.requires_grad_(config.train_words)
        if config.trained_layers is None:
            return
        self.text.requires_grad_(False)
        if config.trained_layers:
            self.text.blocks[-config.trained_layers :].requires_grad_(True)
            self.text.norm_after.requires_grad_(True)
