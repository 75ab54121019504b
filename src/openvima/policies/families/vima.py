"""VIMA: one token for each object in each view, and cross-attention to the prompt.

prompt   [put, the, A front, A top, into, the, B front, B top, ., end]
history  [front 1, front 2, top 1, top 2, action, front 1, …]
                                   |
                              1st action
"""

from openvima.policies.config import PolicyConfig
from openvima.policies.families.common import Size
from openvima.policies.nn.object_encoder import ObjectEncoderConfig
from openvima.policies.nn.vit import VitConfig


def vima(size: Size) -> PolicyConfig:
    """Return VIMA in a size."""
    crop = VitConfig(size.image_width, size.image_layers, size.image_heads, output_width=size.image_width)
    return size.member(ObjectEncoderConfig(crop, size.image_width, size.width), size.decoder())
