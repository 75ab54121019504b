"""Sizes of MIDAS."""

from dataclasses import dataclass, replace
from typing import ClassVar

from openvima.policies.input_layout import InputLayout
from openvima.policies.nn.autoregressive import AutoregressiveConfig
from openvima.policies.nn.decoder import AnyDecoderConfig
from openvima.policies.nn.heads import HeadConfig
from openvima.policies.nn.object_encoder import ObjectEncoderConfig, check_widths
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig
from openvima.policies.sizes import Size


@dataclass(frozen=True, slots=True)
class MidasConfig:
    """Sizes of MIDAS.

    Args:
        images: The object encoder, with a token for each view.
        prompt: The prompt encoder.
        decoder: The decoder.
        head: The action head.
    """

    architecture: ClassVar[str] = "midas"
    images: ObjectEncoderConfig
    prompt: PromptEncoderConfig
    decoder: AnyDecoderConfig
    head: HeadConfig

    def __post_init__(self) -> None:
        check_widths(self.images.width, self.decoder.width)

    @property
    def inputs(self) -> InputLayout:
        """Input format: how images are tokenized."""
        return InputLayout("views")


def midas(of: Size) -> MidasConfig:
    """Return MIDAS in a size."""
    return MidasConfig(
        ObjectEncoderConfig(of.crop_encoder(), of.image_width, of.width),
        replace(of.prompt, visual_residual=True),
        of.prefix_decoder(),
        AutoregressiveConfig(of.hidden_width, of.initial_std, of.action_width),
    )
