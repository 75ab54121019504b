"""Named networks. A preset is a function that returns a config; configs check themselves."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from openvima.errors import UnknownPolicyError, unknown_name

if TYPE_CHECKING:
    from openvima.policies.config import PolicyConfig

FAMILIES = ("vima", "gato", "flamingo", "gpt", "midas")
# Written out, so that listing the names needs no torch; a test compares them with `families.common.SIZES`.
SIZE_NAMES = ("nano", "2m", "4m", "9m", "20m", "43m", "92m", "200m")


def nano() -> "PolicyConfig":
    """2.2 M parameters: small enough to train on two cores within minutes. It points."""
    from openvima.policies.config import PolicyConfig
    from openvima.policies.families.common import size
    from openvima.policies.heads.pointing import PointingConfig
    from openvima.policies.nn.conv_encoder import ConvConfig
    from openvima.policies.nn.object_encoder import ObjectEncoderConfig
    from openvima.policies.nn.trunk import DecoderConfig

    crop = ConvConfig(width=32, output_width=128)
    return PolicyConfig(
        images=ObjectEncoderConfig(
            crop, box_width=64, width=128, fuse_views=True, appearance_width=128, crop_dropout=0.5
        ),
        prompt=size("nano").prompt,
        trunk=DecoderConfig(width=128, num_layers=2, num_self_heads=4, num_cross_heads=4),
        head=PointingConfig(),
        action_width=64,
        query_token=True,
    )


def nano_bins() -> "PolicyConfig":
    """As `nano`, with the table bins of the published policies instead of pointing."""
    from dataclasses import replace

    from openvima.policies.heads.bins import BinsConfig

    return replace(nano(), head=BinsConfig(hidden_width=256))


def small() -> "PolicyConfig":
    """8.5 M parameters: it copies places that it has seen, and compares objects with each other."""
    from openvima.policies.config import PolicyConfig
    from openvima.policies.heads.copying import CopyingConfig
    from openvima.policies.nn.comparison import ComparisonConfig
    from openvima.policies.nn.conv_encoder import ConvConfig
    from openvima.policies.nn.object_encoder import ObjectEncoderConfig
    from openvima.policies.nn.prompt_encoder import PromptEncoderConfig
    from openvima.policies.nn.text_encoder import TextEncoderConfig
    from openvima.policies.nn.trunk import DecoderConfig
    from openvima.policies.tokenizer import vocabulary_size

    crop = ConvConfig(width=48, output_width=192, place_channels=32)
    text = TextEncoderConfig(width=192, num_layers=3, num_heads=6, head_width=32, hidden_width=384)
    return PolicyConfig(
        images=ObjectEncoderConfig(
            crop,
            box_width=64,
            width=192,
            fuse_views=True,
            appearance_width=128,
            crop_dropout=0.35,
            turn_bins=72,
        ),
        prompt=PromptEncoderConfig(text, image_width=192, vocabulary_size=vocabulary_size(), referents=True),
        trunk=DecoderConfig(width=192, num_layers=4, num_self_heads=6, num_cross_heads=6, initial_std=0.05),
        head=CopyingConfig(),
        action_width=64,
        query_token=True,
        comparison=ComparisonConfig(),
    )


def _member(family: str, size_name: str) -> "PolicyConfig":
    from openvima.policies.families.common import size
    from openvima.policies.families.flamingo import flamingo
    from openvima.policies.families.gato import gato
    from openvima.policies.families.gpt import gpt
    from openvima.policies.families.midas import midas
    from openvima.policies.families.vima import vima

    members = {"vima": vima, "gato": gato, "flamingo": flamingo, "gpt": gpt, "midas": midas}
    return members[family](size(size_name))


PRESETS: dict[str, Callable[[], "PolicyConfig"]] = {
    "nano": nano,
    "nano-bins": nano_bins,
    "small": small,
    **{f"{family}-{size}": partial(_member, family, size) for family in FAMILIES for size in SIZE_NAMES},
}


def preset(name: str) -> "PolicyConfig":
    """Return the config of a named network, such as "nano" or "vima-200m".

    Raises:
        UnknownPolicyError: There is no preset of that name.
    """
    if name not in PRESETS:
        hint = f"Allowed: nano, nano-bins, small, and {'|'.join(FAMILIES)}-{'|'.join(SIZE_NAMES)}."
        raise UnknownPolicyError(unknown_name("preset", name, PRESETS, hint))
    return PRESETS[name]()
