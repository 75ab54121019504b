"""Sizes of VIMA-Gato."""

from dataclasses import dataclass
from typing import ClassVar

from openvima.policies.input_layout import InputLayout
from openvima.policies.nn.bins import BinsConfig
from openvima.policies.nn.decoder import AnyDecoderConfig
from openvima.policies.nn.heads import HeadConfig
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig
from openvima.policies.nn.vit import VitConfig, check_frame_encoder
from openvima.policies.sizes import Size


@dataclass(frozen=True, slots=True)
class GatoConfig:
    """Sizes of VIMA-Gato.

    Args:
        frame: The encoder of whole frames; its features are as wide as the decoder.
        prompt: The prompt encoder.
        decoder: The decoder.
        head: The action head.
    """

    architecture: ClassVar[str] = "gato"
    frame: VitConfig
    prompt: PromptEncoderConfig
    decoder: AnyDecoderConfig
    head: HeadConfig

    def __post_init__(self) -> None:
        check_frame_encoder(self.frame, self.decoder.width, class_token=False)

    @property
    def inputs(self) -> InputLayout:
        """Input format: how images are tokenized."""
        size = (self.frame.image_height, self.frame.image_width)
        return InputLayout("frames", size, tokens_per_frame_pair=2 * self.frame.num_patches)


def gato(of: Size) -> GatoConfig:
    """Return VIMA-Gato in a size."""
    head = BinsConfig(of.hidden_width, of.action_width)
    return GatoConfig(of.frame_encoder(class_token=False), of.prompt, of.prefix_decoder(), head)
