"""Sizes of VIMA."""

from dataclasses import dataclass
from typing import ClassVar

from openvima.policies.input_layout import InputLayout
from openvima.policies.nn.bins import BinsConfig
from openvima.policies.nn.conv_encoder import ConvConfig
from openvima.policies.nn.decoder import AnyDecoderConfig, DecoderConfig
from openvima.policies.nn.heads import HeadConfig
from openvima.policies.nn.object_encoder import ObjectEncoderConfig, check_widths
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig
from openvima.policies.sizes import Size, size


@dataclass(frozen=True, slots=True)
class VimaConfig:
    """Sizes of VIMA.

    Args:
        images: The object encoder.
        prompt: The prompt encoder.
        decoder: The decoder.
        head: The action head.
        query_token: Append a learned token to each step's objects and decode the action from there, instead
            of from the last object token.
    """

    architecture: ClassVar[str] = "vima"
    images: ObjectEncoderConfig
    prompt: PromptEncoderConfig
    decoder: AnyDecoderConfig
    head: HeadConfig
    query_token: bool = False

    def __post_init__(self) -> None:
        check_widths(self.images.width, self.decoder.width)

    @property
    def inputs(self) -> InputLayout:
        """Input format: how images are tokenized."""
        return InputLayout("objects" if self.images.fuse_views else "views")


def vima(of: Size) -> VimaConfig:
    """Return VIMA in a size."""
    images = ObjectEncoderConfig(of.crop_encoder(), of.image_width, of.width)
    return VimaConfig(images, of.prompt, of.decoder(), BinsConfig(of.hidden_width, of.action_width))


def nano_bins() -> VimaConfig:
    """As the pointer model `nano`, with the published head: fused views, convolutions, a query token."""
    crop = ConvConfig(width=32, output_width=128)
    images = ObjectEncoderConfig(
        crop, box_width=64, width=128, fuse_views=True, appearance_width=128, crop_dropout=0.5
    )
    decoder = DecoderConfig(width=128, num_layers=2, num_self_heads=4, num_cross_heads=4)
    return VimaConfig(
        images, size("nano").prompt, decoder, BinsConfig(256, action_width=64), query_token=True
    )
