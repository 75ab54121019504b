"""VIMA-Flamingo: four tokens sum up a pair of frames, and cross-attention looks at the prompt, as in VIMA.

prompt   [put, the, 4 latents, into, the, 4 latents, ., end]
history  [4 latents, action, 4 latents, action, …]
                  |
             1st action
"""

from openvima.policies.config import PolicyConfig
from openvima.policies.families.common import Size
from openvima.policies.families.frames import frame_transformer
from openvima.policies.nn.frame_encoder import FrameEncoderConfig
from openvima.policies.nn.resampler import ResamplerConfig


def flamingo(size: Size) -> PolicyConfig:
    """Return VIMA-Flamingo in a size."""
    frame = frame_transformer(size, class_token=False)
    resampler = ResamplerConfig(
        num_blocks=size.resampler_layers,
        num_layers=size.resampler_layers,
        dropout=size.dropout,
        initial_std=size.initial_std,
    )
    return size.member(FrameEncoderConfig(frame, "resampled", resampler), size.decoder())
