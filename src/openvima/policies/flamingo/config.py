"""Sizes of VIMA-Flamingo."""

from dataclasses import dataclass
from typing import ClassVar

from openvima.policies.input_layout import InputLayout
from openvima.policies.nn.bins import BinsConfig
from openvima.policies.nn.decoder import AnyDecoderConfig
from openvima.policies.nn.heads import HeadConfig
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig
from openvima.policies.nn.resampler import ResamplerConfig
from openvima.policies.nn.vit import VitConfig, check_frame_encoder
from openvima.policies.sizes import Size


@dataclass(frozen=True, slots=True)
class FlamingoConfig:
    """Sizes of VIMA-Flamingo.

    Args:
        frame: The encoder of whole frames; its features are as wide as the decoder.
        resampler: The resampler of the patches of both views.
        prompt: The prompt encoder.
        decoder: The decoder.
        head: The action head.
    """

    architecture: ClassVar[str] = "flamingo"
    frame: VitConfig
    resampler: ResamplerConfig
    prompt: PromptEncoderConfig
    decoder: AnyDecoderConfig
    head: HeadConfig

    def __post_init__(self) -> None:
        check_frame_encoder(self.frame, self.decoder.width, class_token=False)

    @property
    def inputs(self) -> InputLayout:
        """Input format: how images are tokenized."""
        size = (self.frame.image_height, self.frame.image_width)
        return InputLayout("frames", size, tokens_per_frame_pair=self.resampler.num_latents)


def flamingo(of: Size) -> FlamingoConfig:
    """Return VIMA-Flamingo in a size."""
    resampler = ResamplerConfig(
        num_blocks=of.resampler_layers,
        num_layers=of.resampler_layers,
        dropout=of.dropout,
        initial_std=of.initial_std,
    )
    head = BinsConfig(of.hidden_width, of.action_width)
    return FlamingoConfig(of.frame_encoder(class_token=False), resampler, of.prompt, of.decoder(), head)
