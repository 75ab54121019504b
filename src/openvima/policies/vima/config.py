"""Sizes of VIMA."""

from dataclasses import dataclass
from typing import ClassVar

from openvima.policies.nn.bins import BinsConfig
from openvima.policies.nn.conv_encoder import ConvConfig
from openvima.policies.nn.decoder import DecoderConfig
from openvima.policies.nn.object_encoder import ObjectEncoderConfig
from openvima.policies.nn.token_policy import TokenPolicyConfig
from openvima.policies.sizes import Size, size


@dataclass(frozen=True, slots=True)
class VimaConfig(TokenPolicyConfig):
    """Sizes of VIMA: objects, and cross-attention to the prompt."""

    architecture: ClassVar[str] = "vima"


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
