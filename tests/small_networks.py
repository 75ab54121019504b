"""Networks that are small enough to be trained in a test."""

from dataclasses import replace

from openvima.policies.nn.conv_encoder import ConvConfig
from openvima.policies.pointer.config import CorrespondenceConfig, PointerConfig, small


def narrow_small(width: int = 32, crop_width: int = 4) -> PointerConfig:
    """The preset small, narrower and shallower, without attributes."""
    sizes = small()
    text = replace(sizes.prompt.text, width=width, num_layers=1, num_heads=2, head_width=16, hidden_width=32)
    crop = ConvConfig(width=crop_width, output_width=4 * crop_width)
    return replace(
        sizes,
        images=replace(sizes.images, crop=crop, box_width=16, width=width),
        prompt=replace(sizes.prompt, text=text, image_width=width),
        decoder=replace(sizes.decoder, width=width, num_layers=1, num_self_heads=2, num_cross_heads=2),
        head=replace(sizes.head, hidden_width=32),
        correspondence=CorrespondenceConfig(hidden_width=32),
        attributes=None,
    )
