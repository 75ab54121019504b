"""Named network sizes. A preset is a function that returns a config; configs check themselves."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from openvima.errors import UnknownPolicyError, unknown_name
from openvima.policies.tokenizer import vocabulary_size

if TYPE_CHECKING:
    from openvima.policies.vima.config import VimaConfig


def nano() -> "VimaConfig":
    """2.5 M parameters: small enough to train on two cores within minutes. It points."""
    from openvima.policies.layers.conv_encoder import ConvConfig
    from openvima.policies.layers.decoder import DecoderConfig
    from openvima.policies.layers.object_encoder import ObjectEncoderConfig
    from openvima.policies.layers.text_encoder import TextEncoderConfig
    from openvima.policies.vima.config import VimaConfig
    from openvima.policies.vima.heads.pointing import PointingConfig

    crop = ConvConfig(width=32, output_width=128)
    return VimaConfig(
        objects=ObjectEncoderConfig(
            crop, box_width=64, width=128, fuse_views=True, appearance_width=128, crop_dropout=0.5
        ),
        text=TextEncoderConfig(width=128, num_layers=2, num_heads=4, head_width=32, hidden_width=256),
        decoder=DecoderConfig(width=128, num_layers=2, num_self_heads=4, num_cross_heads=4),
        prompt_object_width=128,
        action_width=64,
        vocabulary_size=vocabulary_size(),
        pointing=PointingConfig(),
        query_token=True,
    )


def nano_bins() -> "VimaConfig":
    """As `nano`, with the table bins of the published policies instead of pointing."""
    from dataclasses import replace

    from openvima.policies.vima.heads.bins import BinsConfig

    return replace(nano(), pointing=None, bins=BinsConfig(hidden_width=256))


PRESETS: dict[str, Callable[[], "VimaConfig"]] = {"nano": nano, "nano-bins": nano_bins}


def preset(name: str) -> "VimaConfig":
    """Return the sizes of a named network.

    Raises:
        UnknownPolicyError: There is no preset of that name.
    """
    if name not in PRESETS:
        raise UnknownPolicyError(unknown_name("preset", name, PRESETS))
    return PRESETS[name]()
