"""Networks that are small enough to be trained in a test."""

from dataclasses import replace

from openvima.detector.config import BackboneConfig, DetectorConfig
from openvima.policies.nn.image_encoders import ConvConfig
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


def one_level_detector() -> DetectorConfig:
    """Sizes of a detector that trains in moments."""
    return DetectorConfig(
        BackboneConfig("basic", (1,), (8,), stem_width=4, stem_kernel=3, fpn_width=8),
        (32.0,),
        box_head_widths=(8,),
        mask_head_widths=(8,),
        rpn_post_nms_top_n=4,
        rpn_pre_nms_top_n=8,
    )
