"""Sizes of VIMA-GPT."""

from dataclasses import dataclass
from typing import ClassVar

from openvima.policies.nn.bins import BinsConfig
from openvima.policies.nn.token_policy import TokenPolicyConfig
from openvima.policies.sizes import Size


@dataclass(frozen=True, slots=True)
class GptConfig(TokenPolicyConfig):
    """Sizes of VIMA-GPT: one token per pair of frames, and the prompt as prefix."""

    architecture: ClassVar[str] = "gpt"


def gpt(of: Size) -> GptConfig:
    """Return VIMA-GPT in a size."""
    head = BinsConfig(of.hidden_width, of.action_width)
    return GptConfig(of.frame_encoder(class_token=True), of.prompt, of.prefix_decoder(), head)
