"""VIMA: one token for each object in each view, and cross-attention to the prompt.

prompt   [put, the, A front, A top, into, the, B front, B top, ., end]
history  [front 1, front 2, top 1, top 2, action, front 1, …]
                                   |
                              1st action
"""

from openvima.policies.config import PolicyConfig
from openvima.policies.families.common import Size
from openvima.policies.layers.object_encoder import ObjectEncoderConfig
from openvima.policies.layers.trunk import DecoderConfig
from openvima.policies.layers.vit import VitConfig


def vima(size: Size) -> PolicyConfig:
    """Return VIMA in a size."""
    crop = VitConfig(size.image_width, size.image_layers, size.image_heads, output_width=size.image_width)
    return PolicyConfig(
        images=ObjectEncoderConfig(crop, box_width=size.image_width, width=size.width),
        prompt=size.prompt,
        trunk=DecoderConfig(
            size.width, size.num_layers, size.num_heads, size.num_heads, size.dropout, size.initial_std
        ),
        head=size.head,
        action_width=size.action_width,
    )
