"""Sizes of a detector, as a frozen dataclass that validates itself."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from openvima.errors import ConfigError, unknown_name
from openvima.policies.config_fields import build_config

FIRST_STRIDE = 4  # of the finest pyramid level, in pixels


@dataclass(frozen=True, slots=True)
class BackboneConfig:
    """A ResNet with a feature pyramid network (FPN).

    Args:
        block: "basic" (two 3 × 3 convolutions) or "bottleneck" (a 3 × 3 between two 1 × 1 convolutions).
        depths: Blocks per stage; the first stage has stride 4, and the stride doubles with each further one.
        widths: Output channels of each stage.
        stem_width: Channels of the stem.
        stem_kernel: Kernel size of the stem.
        fpn_width: Channels of the pyramid levels.
        extra_level: Max-pool the coarsest level once more, for the largest anchors.
        frozen_batch_norm: Keep the loaded batch statistics. For pretrained weights and small batches.
        stride_in_1x1: Put the stride of a bottleneck into its first 1 × 1 convolution instead of the 3 × 3.
    """

    block: Literal["basic", "bottleneck"]
    depths: tuple[int, ...]
    widths: tuple[int, ...]
    stem_width: int
    stem_kernel: int
    fpn_width: int
    extra_level: bool = False
    frozen_batch_norm: bool = False
    stride_in_1x1: bool = False


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """All sizes and thresholds of a Mask R-CNN.

    Args:
        backbone: ResNet and feature pyramid.
        anchor_sizes: Anchor size of each level in pixels; each cell has three aspect ratios of equal area.
        rpn_foreground_iou: Anchors with at least this IoU are foreground. With anchors far apart for the size
            of the objects, few reach the 0.7 of the published network.
        num_classes: Classes without background; every detection is an object, whatever its class.
        min_size: Images are resized until their shorter side has this many pixels; None keeps their size.
        max_size: Limit of the longer side of resized images.
        channel_order: Of the input: "rgb" or "bgr".
        pixel_mean: Subtracted from each channel (0 to 255), in the input's order.
        pixel_std: Divides each channel, in the input's order.
        rpn_pre_nms_top_n: Boxes per level before non-maximum suppression (NMS).
        rpn_post_nms_top_n: Proposals per image after NMS.
        rpn_nms_iou: NMS threshold of proposals.
        canonical_size: Side in pixels of the boxes that are pooled from `canonical_level`; boxes half as
            large are pooled from the level below.
        canonical_level: Index of a level; the finest is 0.
        roi_sampling_ratio: RoIAlign samples per cell in each direction; 0 adapts to the size of the box.
        box_pool_size: RoIAlign output size of the box head.
        box_head_widths: Hidden widths of the box head.
        mask_pool_size: RoIAlign output size of the mask head; masks have twice this size.
        mask_head_widths: Channels of the convolutions of the mask head.
        score_threshold: Least score of detections.
        nms_iou: NMS threshold of detections.
        max_detections: Detections per image.
    """

    backbone: BackboneConfig
    anchor_sizes: tuple[float, ...]
    rpn_foreground_iou: float = 0.5
    num_classes: int = 1
    min_size: int | None = None
    max_size: int = 1333
    channel_order: Literal["rgb", "bgr"] = "rgb"
    pixel_mean: tuple[float, float, float] = (127.5, 127.5, 127.5)
    pixel_std: tuple[float, float, float] = (63.75, 63.75, 63.75)
    rpn_pre_nms_top_n: int = 100
    rpn_post_nms_top_n: int = 64
    rpn_nms_iou: float = 0.7
    canonical_size: float = 48.0
    canonical_level: int = 1
    roi_sampling_ratio: int = 2
    box_pool_size: int = 7
    box_head_widths: tuple[int, ...] = (128,)
    mask_pool_size: int = 14
    mask_head_widths: tuple[int, ...] = (64, 64)
    score_threshold: float = 0.05
    nms_iou: float = 0.5
    max_detections: int = 100

    def __post_init__(self) -> None:
        backbone = self.backbone
        stages = len(backbone.depths)
        numbers = {len(backbone.widths), len(self.anchor_sizes) - backbone.extra_level}
        if numbers != {stages} or not stages:
            raise ConfigError(
                f"depths has {stages} stages, widths {len(backbone.widths)} and anchor_sizes "
                f"{len(self.anchor_sizes)} numbers; give one per stage, and one more of anchor_sizes for "
                "the extra level."
            )

    def to_dict(self) -> dict[str, Any]:
        """Return nested dictionaries of plain values."""
        return json.loads(json.dumps(asdict(self)))  # tuples become lists

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "DetectorConfig":
        """Build a config from the output of `to_dict`.

        Raises:
            ConfigError: A field is missing or unknown, or the sizes contradict each other.
        """
        return build_config(DetectorConfig, values, "detector")


# 0.57 M parameters, for frames of 128 × 256 pixels; trains from scratch within an hour on two cores.
# Half of the objects are 22 to 25 pixels high and 24 to 26 wide. With these anchors 13 per object have an IoU
# of 0.5; with sizes 16, 32 and 64 it was 5.5.
SMALL = DetectorConfig(
    BackboneConfig(
        block="basic", depths=(1, 1, 1), widths=(32, 64, 128), stem_width=16, stem_kernel=5, fpn_width=32
    ),
    anchor_sizes=(20.0, 28.0, 60.0),
    mask_head_widths=(32, 32),
)
# 44 M parameters: ResNet-50 with FPN, in the default configuration of Detectron2.
RESNET50 = DetectorConfig(
    BackboneConfig(
        block="bottleneck",
        depths=(3, 4, 6, 3),
        widths=(256, 512, 1024, 2048),
        stem_width=64,
        stem_kernel=7,
        fpn_width=256,
        extra_level=True,
        frozen_batch_norm=True,
        stride_in_1x1=True,
    ),
    anchor_sizes=(32.0, 64.0, 128.0, 256.0, 512.0),
    rpn_foreground_iou=0.7,
    min_size=800,
    channel_order="bgr",
    pixel_mean=(103.53, 116.28, 123.675),
    pixel_std=(1.0, 1.0, 1.0),
    rpn_pre_nms_top_n=1000,
    rpn_post_nms_top_n=1000,
    canonical_size=224.0,
    canonical_level=2,
    roi_sampling_ratio=0,
    box_head_widths=(1024, 1024),
    mask_head_widths=(256, 256, 256, 256),
)
DETECTORS = {"small": SMALL, "resnet50": RESNET50}


def detector_config(name: str) -> DetectorConfig:
    """Return the config of a named detector, "small" or "resnet50".

    Raises:
        ConfigError: There is no detector of that name.
    """
    if name not in DETECTORS:
        raise ConfigError(unknown_name("detector", name, DETECTORS))
    return DETECTORS[name]
