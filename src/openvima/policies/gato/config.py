"""Sizes of VIMA-Gato."""

from dataclasses import dataclass
from typing import ClassVar

from openvima.policies.nn.bins import BinsConfig
from openvima.policies.nn.token_policy import TokenPolicyConfig
from openvima.policies.sizes import Size


@dataclass(frozen=True, slots=True)
class GatoConfig(TokenPolicyConfig):
    """Sizes of VIMA-Gato: the patches of frames, and the prompt as prefix."""

    architecture: ClassVar[str] = "gato"


def gato(of: Size) -> GatoConfig:
    """Return VIMA-Gato in a size."""
    head = BinsConfig(of.hidden_width, of.action_width)
    return GatoConfig(of.frame_encoder(class_token=False), of.prompt, of.prefix_decoder(), head)
