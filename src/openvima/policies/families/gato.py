"""VIMA-Gato: every patch of a frame is a token, and the prompt is the beginning of the sequence.

[put, the, 16 patches, into, the, 16 patches, ., end, separator, 16 patches, action, 16 patches, …]
                                                                          |
                                                                     1st action
"""

from openvima.policies.config import PolicyConfig
from openvima.policies.families.common import Size
from openvima.policies.families.frames import frame_transformer
from openvima.policies.layers.frame_encoder import FrameEncoderConfig
from openvima.policies.layers.trunk import PrefixConfig


def gato(size: Size) -> PolicyConfig:
    """Return VIMA-Gato in a size: twice the layers, since a cross block of VIMA counts as one."""
    return PolicyConfig(
        images=FrameEncoderConfig(frame_transformer(size, class_token=False), "patches"),
        prompt=size.prompt,
        trunk=PrefixConfig(size.width, 2 * size.num_layers, size.num_heads, size.dropout, size.initial_std),
        head=size.head,
        action_width=size.action_width,
    )
