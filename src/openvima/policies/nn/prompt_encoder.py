"""The prompt encoder: words and image tokens, interleaved, through a T5 encoder to the decoder's width.

Shape suffixes: B batch, L prompt positions, I image tokens of all prompts, W width of the text encoder, D
width of the decoder, E width of an image token.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from openvima.errors import ConfigError
from openvima.policies.batch import PromptBatch
from openvima.policies.nn.mlp import mlp
from openvima.policies.nn.text_encoder import TextEncoder, TextEncoderConfig


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

    def __post_init__(self) -> None:
        if self.tokenizer not in ("words", "t5"):
            raise ConfigError(f"prompt encoder: tokenizer is {self.tokenizer!r}; allowed: 'words', 't5'.")
        layers = self.text.num_layers
        if self.trained_layers is not None and not 0 <= self.trained_layers <= layers:
            raise ConfigError(
                f"prompt encoder: trained_layers is {self.trained_layers}; it must be between 0 and {layers}."
            )


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
        self._freeze(config)

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

    def _freeze(self, config: PromptEncoderConfig) -> None:
        self.words.requires_grad_(config.train_words)
        if config.trained_layers is None:
            return
        self.text.requires_grad_(False)
        if config.trained_layers:
            self.text.blocks[-config.trained_layers :].requires_grad_(True)
            self.text.norm_after.requires_grad_(True)
