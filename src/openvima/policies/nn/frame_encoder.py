"""Whole frames to tokens, for the baselines: what they see instead of objects.

Shape suffixes: V views (front, top), N frame pairs, P patches of a frame, F width of features, D width of a
token; `...` any axes.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from openvima.errors import ConfigError
from openvima.policies.nn.object_encoder import NUM_VIEWS
from openvima.policies.nn.resampler import Resampler, ResamplerConfig
from openvima.policies.nn.vit import VisionTransformer, VitConfig


@dataclass(frozen=True, slots=True)
class FrameEncoderConfig:
    """Sizes of the frame encoder.

    Args:
        frame: The vision transformer; its features are as wide as the trunk.
        readout: What becomes a token: "patches", each patch of both views (VIMA-Gato); "resampled", learned
            latents that look at these (VIMA-Flamingo); or "class", one token from the class vectors of both
            views (VIMA-GPT).
        resampler: Sizes of the resampler, for "resampled".
    """

    frame: VitConfig
    readout: Literal["patches", "resampled", "class"]
    resampler: ResamplerConfig | None = None

    def __post_init__(self) -> None:
        if self.readout not in ("patches", "resampled", "class"):
            raise ConfigError(
                f"frame encoder: readout is {self.readout!r}; allowed: 'patches', 'resampled', 'class'."
            )
        if self.frame.class_token != (self.readout == "class"):
            raise ConfigError("frame encoder: a class token and readout 'class' go together.")
        if (self.resampler is None) == (self.readout == "resampled"):
            raise ConfigError("frame encoder: a resampler and readout 'resampled' go together.")

    @property
    def width(self) -> int:
        """Width of the trunk."""
        return self.frame.output_width

    @property
    def token_width(self) -> int:
        """Width of what `forward` gives: one class vector for each view side by side, or one feature."""
        return self.width * (NUM_VIEWS if self.readout == "class" else 1)

    @property
    def num_tokens(self) -> int:
        """Tokens of a pair of frames."""
        if self.readout == "class":
            return 1
        return self.resampler.num_latents if self.resampler else NUM_VIEWS * self.frame.num_patches


class FrameEncoder(nn.Module):
    """Frames -> features (`encode_images`), then the features of both views -> tokens (`forward`).

    The tokens of one pair of frames: [front patch 1 … 8, top patch 1 … 8], [latent 1 … 4] or [both].
    """

    def __init__(self, config: FrameEncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.frame_encoder = VisionTransformer(config.frame)
        self.resampler = Resampler(config.resampler, config.width) if config.resampler else None

    def encode_images(self, frames: torch.Tensor) -> torch.Tensor:
        """Encode frames (..., 3, height, width), uint8, to features (..., F), or (..., P, F) of patches."""
        return self.frame_encoder(frames.flatten(0, -4)).unflatten(0, frames.shape[:-3])

    def forward(
        self, features_VNF: torch.Tensor, boxes_VN4: torch.Tensor, masks_VN: torch.Tensor
    ) -> torch.Tensor:
        """Make tokens.

        Args:
            features_VNF: Features of frames, shape (..., 2, N, F) or (..., 2, N, P, F).
            boxes_VN4: Not looked at; objects have boxes.
            masks_VN: Not looked at either.

        Returns:
            Shape (..., tokens · N, token width); the first token of all pairs, then the second of all.
        """
        if self.config.readout == "class":
            return features_VNF.transpose(-3, -2).flatten(-2)
        patches = features_VNF.movedim(-4, -3).flatten(-3, -2)  # (..., N, V · P, F)
        tokens = patches if self.resampler is None else self.resampler(patches)
        return tokens.transpose(-3, -2).flatten(-3, -2)
