"""Reading weights of Detectron2's Mask R-CNN with ResNet-50 and feature pyramid, such as VIMA's detector.

Only tensors and plain values are read; nothing in the file is executed. Where the file holds Detectron2's
settings under "cfg", as users load VIMA's, they say how images are prepared and what is kept. What they leave
open is taken as Detectron2 has it by default: blue first, enlarged to 800 pixels.
"""

import re
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from openvima.detector.checkpoint import copy_weights
from openvima.detector.config import DetectorConfig, resnet50
from openvima.detector.heads import WEIGHTS as BOX_WEIGHTS
from openvima.detector.network import MaskRCNN
from openvima.detector.proposals import WEIGHTS as PROPOSAL_WEIGHTS
from openvima.errors import CheckpointError, ConfigError

_KINDS = "roi_heads.box_predictor.cls_score.weight"
# Module of Detectron2, and ours. Numbers with these names count from other numbers there than here.
_FIRST = {"stage": 2, "block": 0, "layer": 1}
_BOTTOM_UP = (
    (r"backbone\.bottom_up\.stem\.conv1", "backbone.stem"),
    (
        r"backbone\.bottom_up\.res(?P<stage>\d)\.(?P<block>\d+)\.shortcut",
        "backbone.stages.{stage}.{block}.shortcut",
    ),
    (
        r"backbone\.bottom_up\.res(?P<stage>\d)\.(?P<block>\d+)\.conv(?P<layer>\d)",
        "backbone.stages.{stage}.{block}.layers.{layer}",
    ),
)
_OTHERS = (
    (r"backbone\.fpn_lateral(?P<stage>\d)", "backbone.lateral.{stage}"),
    (r"backbone\.fpn_output(?P<stage>\d)", "backbone.smooth.{stage}"),
    (r"proposal_generator\.rpn_head\.conv", "proposals.conv"),
    (r"proposal_generator\.rpn_head\.objectness_logits", "proposals.scores"),
    (r"proposal_generator\.rpn_head\.anchor_deltas", "proposals.deltas"),
    (r"roi_heads\.box_head\.fc(?P<layer>\d)", "box_head.hidden.{layer}"),
    (r"roi_heads\.box_predictor\.cls_score", "box_head.kinds"),
    (r"roi_heads\.box_predictor\.bbox_pred", "box_head.deltas"),
    (r"roi_heads\.mask_head\.mask_fcn(?P<layer>\d)", "mask_head.convs.{layer}"),
    (r"roi_heads\.mask_head\.deconv", "mask_head.finer"),
    (r"roi_heads\.mask_head\.predictor", "mask_head.masks"),
)
# Settings of Detectron2 by their path, and ours.
_SETTINGS = {
    "INPUT.MIN_SIZE_TEST": "short_side",
    "INPUT.MAX_SIZE_TEST": "long_side",
    "INPUT.FORMAT": "colours",
    "MODEL.PIXEL_MEAN": "pixel_mean",
    "MODEL.PIXEL_STD": "pixel_std",
    "MODEL.ANCHOR_GENERATOR.SIZES": "anchor_sizes",
    "MODEL.RPN.PRE_NMS_TOPK_TEST": "candidates",
    "MODEL.RPN.POST_NMS_TOPK_TEST": "proposals",
    "MODEL.RPN.NMS_THRESH": "proposal_overlap",
    "MODEL.ROI_BOX_HEAD.POOLER_SAMPLING_RATIO": "samples",
    "MODEL.ROI_HEADS.SCORE_THRESH_TEST": "score",
    "MODEL.ROI_HEADS.NMS_THRESH_TEST": "overlap",
    "TEST.DETECTIONS_PER_IMAGE": "most",
}
_STRIDE_FIRST = "MODEL.RESNETS.STRIDE_IN_1X1"
# Settings that are not shapes of weights, and the only value that is computed here.
_FIXED: dict[str, Any] = {  # Any: numbers, words and lists of them
    "MODEL.ANCHOR_GENERATOR.ASPECT_RATIOS": [[0.5, 1.0, 2.0]],
    "MODEL.ANCHOR_GENERATOR.OFFSET": 0.0,
    "MODEL.FPN.FUSE_TYPE": "sum",
    "MODEL.RPN.BBOX_REG_WEIGHTS": PROPOSAL_WEIGHTS,
    "MODEL.ROI_BOX_HEAD.BBOX_REG_WEIGHTS": BOX_WEIGHTS,
    "MODEL.ROI_BOX_HEAD.POOLER_TYPE": "ROIAlignV2",
    "MODEL.ROI_MASK_HEAD.POOLER_TYPE": "ROIAlignV2",
}
_CLASSES_OF_SETTINGS = ("detectron2.config.config", "fvcore.common.config", "yacs.config")
# Constants that are set by the sizes here, and counters without effect.
_LEFT_OUT = re.compile(r"pixel_(mean|std)|.*anchor_generator\..*|.*num_batches_tracked")


def load_detectron2(file: str | Path) -> MaskRCNN:
    """Read a network from a file of Detectron2.

    Args:
        file: A torch archive (`.pth`) that holds the weights by name, alone or under "model".

    Returns:
        The network, in float32 and in evaluation mode.

    Raises:
        CheckpointError: The file is missing, damaged or something else, it wants code to be executed, or its
            weights or settings are those of another architecture.
    """
    file = Path(file)
    values = _values_in(file)
    weights, settings = _weights_in(values, file), values.get("cfg")
    try:
        config = detectron2_config(weights, settings if isinstance(settings, Mapping) else None)
    except (ConfigError, TypeError, ValueError) as error:  # settings may be anything
        raise CheckpointError(f"{file} holds settings that make no sense: {error}") from error
    network = MaskRCNN(config)
    copy_weights(network, from_detectron2(weights), source=str(file))
    return network.eval()


def detectron2_config(
    weights: Mapping[str, torch.Tensor],
    settings: Mapping[str, Any] | None = None,  # Any: as stored
) -> DetectorConfig:
    """Return the sizes of a network with these weights: ResNet-50 with as many kinds as they tell apart.

    Args:
        weights: Where means and deviations of the pixels are stored among them, they are taken from there.
        settings: Detectron2's, nested by name; those that are missing are as it has them by default.

    Raises:
        CheckpointError: They are those of no Mask R-CNN, or of one that computes otherwise.
    """
    if _KINDS not in weights:
        raise CheckpointError(f"there are no weights {_KINDS}; a Mask R-CNN of Detectron2 has them.")
    config = replace(resnet50(), num_classes=len(weights[_KINDS]) - 1, **_chosen(settings or {}))
    stored = {
        name: tuple(float(value) for value in weights[name].flatten())
        for name in ("pixel_mean", "pixel_std")
        if name in weights
    }
    return replace(config, **stored)  # type: ignore[arg-type]  # three numbers each


def from_detectron2(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the weights under the names that they have here; names that are not known stay."""
    return {
        _own_name(name): tensor.float() for name, tensor in weights.items() if not _LEFT_OUT.fullmatch(name)
    }


def _chosen(settings: Mapping[str, Any]) -> dict[str, Any]:  # Any: as stored
    """What settings of Detectron2 say, under the names that it has here."""
    for path, expected in _FIXED.items():
        value = _setting(settings, path)
        if value is not None and _listed(value) != _listed(expected):
            raise CheckpointError(f"{path} is {value!r}; only {expected!r} is computed here.")
    chosen = {
        own: value for path, own in _SETTINGS.items() if (value := _setting(settings, path)) is not None
    }
    for name in ("pixel_mean", "pixel_std"):
        if name in chosen:
            chosen[name] = tuple(float(number) for number in chosen[name])
    if "anchor_sizes" in chosen:
        if any(len(sizes) != 1 for sizes in chosen["anchor_sizes"]):
            raise CheckpointError(
                f"anchors have sizes {chosen['anchor_sizes']}; one of each level is computed."
            )
        chosen["anchor_sizes"] = tuple(float(sizes[0]) for sizes in chosen["anchor_sizes"])
    if "colours" in chosen:
        chosen["colours"] = str(chosen["colours"]).lower()
    if "short_side" in chosen:
        chosen["short_side"] = chosen["short_side"] or None  # 0 leaves images as they are
    if (stride_first := _setting(settings, _STRIDE_FIRST)) is not None:
        chosen["backbone"] = replace(resnet50().backbone, stride_first=stride_first)
    return chosen


def _setting(settings: Mapping[str, Any], path: str) -> Any:  # Any: as stored
    value: Any = settings
    for name in path.split("."):
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def _listed(value: Any) -> Any:  # Any: as stored
    return [_listed(part) for part in value] if isinstance(value, list | tuple) else value


def _own_name(name: str) -> str:
    for table, conv in ((_BOTTOM_UP, "conv."), (_OTHERS, "")):  # there a norm is part of its convolution
        for pattern, own in table:
            if match := re.fullmatch(pattern + r"\.(?P<tensor>(norm\.)?\w+)", name):
                numbers = {
                    key: int(match[key]) - first
                    for key, first in _FIRST.items()
                    if key in match.re.groupindex
                }
                tensor = match["tensor"]
                return f"{own.format(**numbers)}.{'' if tensor.startswith('norm.') else conv}{tensor}"
    return name


def _class_of_settings(module: str) -> type:
    """A class that stands in for Detectron2's of that module: torch makes it, and gets a mapping instead."""
    return type("CfgNode", (), {"__module__": module, "__new__": lambda cls: OrderedDict()})


def _values_in(file: Path) -> Mapping[str, Any]:  # Any: whatever it holds
    if not file.is_file():
        raise CheckpointError(f"there is no file {file}.")
    try:
        with torch.serialization.safe_globals([*map(_class_of_settings, _CLASSES_OF_SETTINGS)]):
            values: Any = torch.load(file, map_location="cpu", weights_only=True)  # Any: as above
    except MemoryError:
        raise
    except Exception as error:  # a file made to do harm can fail in any way
        reason = (str(error).splitlines() or [""])[0]
        raise CheckpointError(
            f"{file} cannot be read as tensors alone ({type(error).__name__}: {reason}). Nothing in it was "
            'executed. Give a .pth file of torch; of a training checkpoint, save the entry "model" alone.'
        ) from error
    if not isinstance(values, Mapping):
        raise CheckpointError(f"{file} holds a {type(values).__name__}; weights by name are needed.")
    return values


def _weights_in(values: Mapping[str, Any], file: Path) -> dict[str, torch.Tensor]:  # Any: as above
    values = values.get("model", {name: value for name, value in values.items() if name != "cfg"})
    if not isinstance(values, Mapping) or not values:
        raise CheckpointError(f"{file} holds no weights by name.")
    tensors = {
        str(name): torch.from_numpy(value) if isinstance(value, np.ndarray) else value
        for name, value in values.items()
    }
    if others := [name for name, value in tensors.items() if not isinstance(value, torch.Tensor)]:
        raise CheckpointError(f"{file} holds more than weights: {', '.join(others[:5])}.")
    return tensors
