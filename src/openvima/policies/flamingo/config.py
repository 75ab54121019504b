"""Sizes of VIMA-Flamingo."""

from dataclasses import dataclass
from typing import ClassVar

from openvima.policies.nn.bins import BinsConfig
from openvima.policies.nn.token_policy import TokenPolicyConfig
from openvima.policies.sizes import Size


@dataclass(frozen=True, slots=True)
class FlamingoConfig(TokenPolicyConfig):
    """Sizes of VIMA-Flamingo: resampled patches of frames, and cross-attention to the prompt."""

    architecture: ClassVar[str] = "flamingo"


def flamingo(of: Size) -> FlamingoConfig:
    """Return VIMA-Flamingo in a size."""
    head = BinsConfig(of.hidden_width, of.action_width)
    return FlamingoConfig(of.frame_encoder(class_token=False), of.prompt, of.decoder(), head, of.resampler())
