"""The seven published model sizes, and one that trains on a CPU."""

from dataclasses import dataclass, replace

from openvima.policies.nn.action_head import BinsConfig
from openvima.policies.nn.decoder import DecoderConfig, PrefixDecoderConfig
from openvima.policies.nn.image_encoders import ResamplerConfig, VitConfig
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig, TextEncoderConfig

T5_VOCABULARY_SIZE = 32128
VOCABULARY_SIZE = 768  # padding, end, 361 numbers, the 160 words of the benchmark, and a reserve
# Encoders of T5 1.0, by the names of their files.
T5_SIZES = {
    "t5-small": TextEncoderConfig(width=512, num_layers=6, num_heads=8, head_width=64, hidden_width=2048),
    "t5-base": TextEncoderConfig(width=768, num_layers=12, num_heads=12, head_width=64, hidden_width=3072),
    "t5-large": TextEncoderConfig(width=1024, num_layers=24, num_heads=16, head_width=64, hidden_width=4096),
}
TUNED_T5_LAYERS = 2  # as in the paper


@dataclass(frozen=True, slots=True)
class Size:
    """A model size, for every published architecture.

    Args:
        width: Width of the decoder.
        num_layers: Pairs of a cross block and a self block.
        num_heads: Heads of self- and of cross-attention.
        prompt: The prompt encoder.
        image_width: Width of the image encoder.
        image_layers: Layers of the image encoder.
        image_heads: Heads of the image encoder.
        resampler_layers: Self-attention layers of the resampler, and the number of passes.
        hidden_width: Hidden width of the action heads.
        action_width: Width of the features of each part of a past action.
        dropout: Dropout probability.
        initial_std: Standard deviation of the decoder's fresh weights.
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
        """Return the decoder with cross-attention to the prompt."""
        heads = self.num_heads
        return DecoderConfig(self.width, self.num_layers, heads, heads, self.dropout, self.initial_std)

    def prefix_decoder(self) -> PrefixDecoderConfig:
        """Return the decoder with the prompt as prefix.

        It has twice the layers, since the other decoder counts a pair of blocks as one.
        """
        return PrefixDecoderConfig(
            self.width, 2 * self.num_layers, self.num_heads, self.dropout, self.initial_std
        )

    def bins(self) -> BinsConfig:
        """Return the published action head."""
        return BinsConfig(self.hidden_width, self.action_width)

    def crop_encoder(self) -> VitConfig:
        """Return the encoder of object crops: 16 × 16 patches of 32 × 32 pixels."""
        return VitConfig(self.image_width, self.image_layers, self.image_heads, output_width=self.image_width)

    def frame_encoder(self, *, class_token: bool) -> VitConfig:
        """Return the encoder of whole frames: eight 32 × 32 patches of 64 × 128 pixels."""
        return replace(
            self.crop_encoder(),
            output_width=self.width,
            patch_size=32,
            image_height=64,
            image_width=128,
            class_token=class_token,
        )

    def resampler(self) -> ResamplerConfig:
        """Return the resampler: four latents."""
        layers = self.resampler_layers
        return ResamplerConfig(
            num_blocks=layers, num_layers=layers, dropout=self.dropout, initial_std=self.initial_std
        )


def t5_prompt_encoder(name: str) -> PromptEncoderConfig:
    """Return the prompt encoder with one of `T5_SIZES`; as in the paper, its last two layers are trained."""
    text = T5_SIZES[name]
    return PromptEncoderConfig(
        text,
        image_width=text.width,
        vocabulary_size=T5_VOCABULARY_SIZE,
        tokenizer="t5",
        train_words=False,
        trained_layers=TUNED_T5_LAYERS,
    )


def t5_name(text: TextEncoderConfig) -> str:
    """Return name and sizes of a T5 1.0, for messages."""
    sizes = (
        f"{text.width} wide, {text.num_layers} layers, {text.num_heads} heads of {text.head_width}, "
        f"{text.hidden_width} hidden"
    )
    return next((f"{name} ({sizes})" for name, of in T5_SIZES.items() if of == text), sizes)


def _published(width: int, num_layers: int) -> Size:
    return Size(width, num_layers, num_heads=width // 32, prompt=t5_prompt_encoder("t5-base"))


def _nano() -> Size:
    text = TextEncoderConfig(width=128, num_layers=2, num_heads=4, head_width=32, hidden_width=256)
    return Size(
        width=128,
        num_layers=2,
        num_heads=4,
        prompt=PromptEncoderConfig(text, image_width=128, vocabulary_size=VOCABULARY_SIZE),
        image_width=96,
        image_layers=2,
        image_heads=4,
        resampler_layers=2,
        hidden_width=256,
        action_width=64,
        dropout=0.0,  # short trainings see each demonstration a few times
        initial_std=0.05,  # keeps the signal scale of width 768; with 0.02 it nearly vanishes
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
