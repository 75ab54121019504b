"""Sizes of a detector, as a frozen record that checks itself and travels beside the weights."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from openvima.errors import ConfigError, unknown_name

FIRST_STRIDE = 4  # pixels between the cells of the finest level of the pyramid


@dataclass(frozen=True, slots=True)
class BackboneConfig:
    """A residual network, and the pyramid on top of it.

    Args:
        block: "basic" is two 3 × 3 convolutions, "bottleneck" a 3 × 3 one between two of 1 × 1.
        depths: Blocks of each stage; the first stage has stride 4, and each further one twice that before.
        widths: Channels that each stage gives.
        stem_width: Channels of the first convolution.
        stem_kernel: Its size in pixels.
        pyramid_width: Channels of all levels of the pyramid.
        extra_level: Whether the coarsest level is thinned out once more, for the largest anchors.
        frozen_norms: Whether batch normalisation keeps the statistics it was loaded with. For weights that
            were trained before, which small batches would spoil.
        stride_first: Whether the first 1 × 1 convolution of a bottleneck does the stride, rather than the
            3 × 3 one.
    """

    block: Literal["basic", "bottleneck"]
    depths: tuple[int, ...]
    widths: tuple[int, ...]
    stem_width: int
    stem_kernel: int
    pyramid_width: int
    extra_level: bool = False
    frozen_norms: bool = False
    stride_first: bool = False

    @property
    def num_levels(self) -> int:
        """Levels of the pyramid."""
        return len(self.widths) + self.extra_level


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """All sizes of a Mask R-CNN, and what it was trained to look at.

    Args:
        backbone: From the image to the levels of the pyramid.
        anchor_sizes: Side in pixels of the square anchor of each level; two others have its area and are
            half and twice as high as wide.
        anchor_overlap: Anchors that overlap an object at least that much learn it. Where anchors lie far
            apart for the size of objects, few reach the 0.7 of the published network.
        num_classes: Kinds of objects that it tells apart; what it finds is an object whatever its kind.
        short_side: Images are enlarged until their shorter side has so many pixels; None leaves them.
        long_side: Their longer side stays within so many pixels all the same.
        colours: Order in which the network takes the channels.
        pixel_mean: Subtracted from each channel, in the network's order, 0 to 255.
        pixel_std: Each channel is then divided by this.
        candidates: Boxes of each level that the proposal network lets compete.
        proposals: Boxes of an image that are looked at closely.
        proposal_overlap: Largest overlap (intersection over union) of two proposals.
        canonical_size: Side in pixels of the objects that are cut out of `canonical_level`; one half as
            large is cut out of the level before.
        canonical_level: Number of a level, the finest being 0.
        samples: Points in each direction that a cell of a cut-out averages; 0 takes about one a feature.
        box_size: Cells in each direction of what the box head gets.
        box_widths: Widths of its hidden layers.
        mask_size: Cells in each direction of what the mask head gets; its masks are twice as fine.
        mask_widths: Channels of its convolutions.
        score: Least score of what is found.
        overlap: Largest overlap of two objects that are found.
        most: Objects of an image that are found.
    """

    backbone: BackboneConfig
    anchor_sizes: tuple[float, ...]
    anchor_overlap: float = 0.5
    num_classes: int = 1
    short_side: int | None = None
    long_side: int = 1333
    colours: Literal["rgb", "bgr"] = "rgb"
    pixel_mean: tuple[float, float, float] = (127.5, 127.5, 127.5)
    pixel_std: tuple[float, float, float] = (63.75, 63.75, 63.75)
    candidates: int = 100
    proposals: int = 64
    proposal_overlap: float = 0.7
    canonical_size: float = 48.0
    canonical_level: int = 1
    samples: int = 2
    box_size: int = 7
    box_widths: tuple[int, ...] = (128,)
    mask_size: int = 14
    mask_widths: tuple[int, ...] = (64, 64)
    score: float = 0.05
    overlap: float = 0.5
    most: int = 100

    def __post_init__(self) -> None:
        backbone, problems = self.backbone, []
        if backbone.block not in ("basic", "bottleneck"):
            problems.append(unknown_name("block", backbone.block, ("basic", "bottleneck")))
        if self.colours not in ("rgb", "bgr"):
            problems.append(unknown_name("order of colours", self.colours, ("rgb", "bgr")))
        if len(backbone.depths) != len(backbone.widths) or not backbone.depths:
            problems.append(
                f"depths has {len(backbone.depths)} stages and widths {len(backbone.widths)}; give one "
                "number a stage in both."
            )
        if len(self.anchor_sizes) != backbone.num_levels:
            problems.append(
                f"anchor_sizes has {len(self.anchor_sizes)} numbers; the pyramid has {backbone.num_levels} "
                "levels."
            )
        for name in ("num_classes", "candidates", "proposals", "box_size", "mask_size", "most"):
            if getattr(self, name) < 1:
                problems.append(f"{name} is {getattr(self, name)}; it must be at least 1.")
        if problems:
            raise ConfigError(" ".join(problems))

    def to_dict(self) -> dict[str, Any]:  # Any: plain YAML values
        """Return nested dictionaries of plain values, for files."""
        return _plain(asdict(self))

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "DetectorConfig":  # Any: as read from a file
        """Build a config from what `to_dict` returned.

        Raises:
            ConfigError: A field is missing or unknown, or the sizes contradict each other.
        """
        given = dict(values)
        backbone = _build(BackboneConfig, given.pop("backbone", None), "backbone")
        return _build(DetectorConfig, {**given, "backbone": backbone}, "detector")


def small() -> DetectorConfig:
    """0.96 M parameters, for frames of 128 × 256 pixels; trained from nothing within an hour on two cores."""
    backbone = BackboneConfig(
        block="basic",
        depths=(1, 1, 1),
        widths=(32, 64, 128),
        stem_width=16,
        stem_kernel=5,
        pyramid_width=64,
    )
    # Half of the objects are 22 to 25 pixels high and 24 to 26 wide. With these sizes 13 anchors an object
    # overlap it by half; with 16, 32 and 64 there were 5.5.
    return DetectorConfig(backbone, anchor_sizes=(20.0, 28.0, 60.0))


def resnet50() -> DetectorConfig:
    """44 M parameters: ResNet-50 with feature pyramid, as Detectron2 sets it up by default."""
    backbone = BackboneConfig(
        block="bottleneck",
        depths=(3, 4, 6, 3),
        widths=(256, 512, 1024, 2048),
        stem_width=64,
        stem_kernel=7,
        pyramid_width=256,
        extra_level=True,
        frozen_norms=True,
        stride_first=True,
    )
    return DetectorConfig(
        backbone,
        anchor_sizes=(32.0, 64.0, 128.0, 256.0, 512.0),
        anchor_overlap=0.7,
        short_side=800,
        colours="bgr",
        pixel_mean=(103.53, 116.28, 123.675),
        pixel_std=(1.0, 1.0, 1.0),
        candidates=1000,
        proposals=1000,
        canonical_size=224.0,
        canonical_level=2,
        samples=0,
        box_widths=(1024, 1024),
        mask_widths=(256, 256, 256, 256),
    )


DETECTORS: dict[str, Callable[[], DetectorConfig]] = {"small": small, "resnet50": resnet50}


def detector_config(name: str) -> DetectorConfig:
    """Return the sizes of a named detector, "small" or "resnet50".

    Raises:
        ConfigError: There is no detector of that name.
    """
    if name not in DETECTORS:
        raise ConfigError(unknown_name("detector", name, DETECTORS))
    return DETECTORS[name]()


def _plain(value: Any) -> Any:  # Any: nested plain values
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    return list(value) if isinstance(value, tuple) else value


def _build(kind: type, values: Any, where: str) -> Any:  # Any: dataclasses of two kinds
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where} is {values!r}; it must be a mapping of the fields of {kind.__name__}.")
    names = [field.name for field in fields(kind)]
    unknown = [str(name) for name in values if name not in names]
    if unknown:
        raise ConfigError(f"{where} has unknown fields {', '.join(unknown)}; allowed: {', '.join(names)}.")
    arguments = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    try:
        return kind(**arguments)
    except TypeError as error:
        raise ConfigError(f"{where}: {error}.") from error
