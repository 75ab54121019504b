"""Sizes of MIDAS."""

from dataclasses import dataclass, replace
from typing import ClassVar

from openvima.policies.nn.autoregressive import AutoregressiveConfig
from openvima.policies.nn.object_encoder import ObjectEncoderConfig
from openvima.policies.nn.token_policy import TokenPolicyConfig
from openvima.policies.sizes import Size


@dataclass(frozen=True, slots=True)
class MidasConfig(TokenPolicyConfig):
    """Sizes of MIDAS: objects with a token for each view, and the prompt as prefix."""

    architecture: ClassVar[str] = "midas"


def midas(of: Size) -> MidasConfig:
    """Return MIDAS in a size."""
    return MidasConfig(
        ObjectEncoderConfig(of.crop_encoder(), of.image_width, of.width),
        replace(of.prompt, visual_residual=True),
        of.prefix_decoder(),
        AutoregressiveConfig(of.hidden_width, of.initial_std, of.action_width),
    )
