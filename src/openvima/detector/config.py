"""Sizes of a detector, as a frozen dataclass that validates itself."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from openvima.errors import ConfigError, unknown_name
from openvima.policies.config_fields import build_config

FIRST_STRIDE = 4  # of the finest pyramid level, in pixels
# Fields of configs that were written when there was a ResNet-50, too; `small` had one value for each.
_RETIRED = frozenset({"min_size", "max_size", "channel_order", "block", "extra_level"}) | {
    "frozen_batch_norm",
    "stride_in_1x1",
}


@dataclass(frozen=True, slots=True)
class BackboneConfig:
    """A ResNet with a feature pyramid network (FPN).

    Args:
        depths: Blocks per stage; the first stage has stride 4, and the stride doubles with each further one.
        widths: Output channels of each stage.
        stem_width: Channels of the stem.
        stem_kernel: Kernel size of the stem.
        fpn_width: Channels of the pyramid levels.
    """

    depths: tuple[int, ...]
    widths: tuple[int, ...]
    stem_width: int
    stem_kernel: int
    fpn_width: int


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """All sizes and thresholds of a Mask R-CNN.

    Args:
        backbone: ResNet and feature pyramid.
        anchor_sizes: Anchor size of each level in pixels; each cell has three aspect ratios of equal area.
        rpn_foreground_iou: Anchors with at least this IoU are foreground. With anchors far apart for the size
            of the objects, few reach the usual 0.7.
        num_classes: Classes without background; every detection is an object, whatever its class.
        pixel_mean: Subtracted from each channel (0 to 255).
        pixel_std: Divides each channel.
        rpn_pre_nms_top_n: Boxes per level before non-maximum suppression (NMS).
        rpn_post_nms_top_n: Proposals per image after NMS.
        rpn_nms_iou: NMS threshold of proposals.
        canonical_size: Side in pixels of the boxes that are pooled from `canonical_level`; boxes half as
            large are pooled from the level below.
        canonical_level: Index of a level; the finest is 0.
        roi_sampling_ratio: RoIAlign samples per cell in each direction.
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
        stages = len(self.backbone.depths), len(self.backbone.widths), len(self.anchor_sizes)
        if len({*stages}) > 1 or not stages[0]:
            raise ConfigError(
                f"depths, widths and anchor_sizes have {str(stages)[1:-1]} numbers; give one per stage."
            )

    def to_dict(self) -> dict[str, Any]:
        """Return nested dictionaries of plain values."""
        return _plain(asdict(self))

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "DetectorConfig":
        """Build a config from the output of `to_dict`.

        Raises:
            ConfigError: A field is missing or unknown, or the sizes contradict each other.
        """
        backbone = values.get("backbone")
        kept = {name: value for name, value in values.items() if name not in _RETIRED}
        if isinstance(backbone, Mapping):
            kept["backbone"] = {name: value for name, value in backbone.items() if name not in _RETIRED}
        return build_config(DetectorConfig, kept, "detector")


def small() -> DetectorConfig:
    """0.57 M parameters, for frames of 128 × 256 pixels; trains from scratch within an hour on two cores."""
    backbone = BackboneConfig(
        depths=(1, 1, 1), widths=(32, 64, 128), stem_width=16, stem_kernel=5, fpn_width=32
    )
    # Half of the objects are 22 to 25 pixels high and 24 to 26 wide. With these sizes 13 anchors per object
    # have an IoU of 0.5; with 16, 32 and 64 it was 5.5.
    return DetectorConfig(backbone, anchor_sizes=(20.0, 28.0, 60.0), mask_head_widths=(32, 32))


DETECTORS: dict[str, Callable[[], DetectorConfig]] = {"small": small}


def detector_config(name: str) -> DetectorConfig:
    """Return the config of a named detector, "small".

    Raises:
        ConfigError: There is no detector of that name.
    """
    if name not in DETECTORS:
        raise ConfigError(unknown_name("detector", name, DETECTORS))
    return DETECTORS[name]()


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    return list(value) if isinstance(value, tuple) else value
