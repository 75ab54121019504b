"""The transformer over whole frames, which the three baselines share."""

from openvima.policies.families.common import Size
from openvima.policies.nn.vit import VitConfig


def frame_transformer(size: Size, *, class_token: bool) -> VitConfig:
    """Eight patches of 32 × 32 pixels in a frame of 64 × 128, features as wide as the trunk."""
    return VitConfig(
        size.image_width,
        size.image_layers,
        size.image_heads,
        output_width=size.width,
        patch_size=32,
        image_height=64,
        image_width=128,
        class_token=class_token,
    )
