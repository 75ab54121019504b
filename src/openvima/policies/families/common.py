"""What the members of the family have in common: sizes, prompt encoder, heads."""

from dataclasses import dataclass

from openvima.errors import UnknownPolicyError, unknown_name
from openvima.policies.config import PolicyConfig
from openvima.policies.heads.bins import BinsConfig
from openvima.policies.nn.frame_encoder import FrameEncoderConfig
from openvima.policies.nn.object_encoder import ObjectEncoderConfig
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig
from openvima.policies.nn.text_encoder import TextEncoderConfig
from openvima.policies.nn.trunk import DecoderConfig, PrefixConfig
from openvima.policies.tokenizer import vocabulary_size

T5_VOCABULARY_SIZE = 32128
T5_BASE = TextEncoderConfig(width=768, num_layers=12, num_heads=12, head_width=64, hidden_width=3072)
TUNED_T5_LAYERS = 2  # as in the paper


@dataclass(frozen=True, slots=True)
class Size:
    """A size of the family.

    Args:
        width: Width of the trunk.
        num_layers: Pairs of a cross block and a self block.
        num_heads: Heads of either attention.
        image_width: Width of the image encoder.
        image_layers: Layers of the image encoder.
        image_heads: Heads of the image encoder.
        hidden_width: Hidden width of the action heads.
        resampler_layers: Self layers of VIMA-Flamingo's resampler, and how often they are run through.
        prompt: The prompt encoder.
        action_width: Width of the features of each part of a past action.
        dropout: Share of values dropped in training.
        initial_std: Standard deviation of the trunk's fresh weights.
    """

    width: int
    num_layers: int
    num_heads: int
    prompt: PromptEncoderConfig
    image_width: int = 768
    image_layers: int = 4
    image_heads: int = 24
    resampler_layers: int = 4
    hidden_width: int = 512
    action_width: int = 256
    dropout: float = 0.1
    initial_std: float = 0.02

    def decoder(self) -> DecoderConfig:
        """Return the trunk with cross-attention to the prompt."""
        heads = self.num_heads
        return DecoderConfig(self.width, self.num_layers, heads, heads, self.dropout, self.initial_std)

    def prefix(self) -> PrefixConfig:
        """Return the trunk that has the prompt before the history.

        It has twice the layers, since a cross block of the decoder counts as one.
        """
        return PrefixConfig(self.width, 2 * self.num_layers, self.num_heads, self.dropout, self.initial_std)

    def member(
        self, images: ObjectEncoderConfig | FrameEncoderConfig, trunk: DecoderConfig | PrefixConfig
    ) -> PolicyConfig:
        """Complete what a member has of its own with what all share."""
        head = BinsConfig(self.hidden_width)
        return PolicyConfig(images, self.prompt, trunk, head, self.action_width)


def _published(width: int, num_layers: int) -> Size:
    prompt = PromptEncoderConfig(
        text=T5_BASE,
        image_width=768,
        vocabulary_size=T5_VOCABULARY_SIZE,
        tokenizer="t5",
        train_words=False,
        trained_layers=TUNED_T5_LAYERS,
    )
    return Size(width, num_layers, num_heads=width // 32, prompt=prompt)


def _nano() -> Size:
    text = TextEncoderConfig(width=128, num_layers=2, num_heads=4, head_width=32, hidden_width=256)
    return Size(
        width=128,
        num_layers=2,
        num_heads=4,
        prompt=PromptEncoderConfig(text, image_width=128, vocabulary_size=vocabulary_size()),
        image_width=96,
        image_layers=2,
        image_heads=4,
        resampler_layers=2,
        hidden_width=256,
        action_width=64,
        initial_std=0.05,  # as much signal gets through as at width 768; with 0.02 it nearly dies out
    )


# Widths and layers of the paper's sizes, named after the parameters in the blocks of the decoder.
SIZES: dict[str, Size] = {
    "nano": _nano(),
    "2m": _published(256, 1),
    "4m": _published(256, 2),
    "9m": _published(320, 3),
    "20m": _published(384, 4),
    "43m": _published(512, 5),
    "92m": _published(640, 7),
    "200m": _published(768, 11),
}


def size(name: str) -> Size:
    """Return a size by name.

    Raises:
        UnknownPolicyError: There is none of that name.
    """
    if name not in SIZES:
        raise UnknownPolicyError(unknown_name("size", name, SIZES))
    return SIZES[name]
