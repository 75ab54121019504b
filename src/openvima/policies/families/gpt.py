"""VIMA-GPT: one token sums up a pair of frames, and the prompt is the beginning of the sequence.

[put, the, A, into, the, B, ., end, separator, frames, action, frames, action, …]
                                                    |
                                               1st action
"""

from openvima.policies.config import PolicyConfig
from openvima.policies.families.common import Size
from openvima.policies.families.frames import frame_transformer
from openvima.policies.layers.frame_encoder import FrameEncoderConfig
from openvima.policies.layers.trunk import PrefixConfig


def gpt(size: Size) -> PolicyConfig:
    """Return VIMA-GPT in a size: twice the layers, since a cross block of VIMA counts as one."""
    return PolicyConfig(
        images=FrameEncoderConfig(frame_transformer(size, class_token=True), "class"),
        prompt=size.prompt,
        trunk=PrefixConfig(size.width, 2 * size.num_layers, size.num_heads, size.dropout, size.initial_std),
        head=size.head,
        action_width=size.action_width,
    )
