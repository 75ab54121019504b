"""Reading weights of Detectron2's Mask R-CNN with ResNet-50 and feature pyramid, such as VIMA's detector.

Only tensors are read; nothing in the file is executed. The file does not say how images are to be prepared:
`detectron2_config` takes what Detectron2 does by default, for blue-green-red images of 800 pixels.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from openvima.detection.checkpoint import copy_weights
from openvima.detection.config import DetectorConfig, resnet50
from openvima.detection.network import MaskRCNN
from openvima.errors import CheckpointError

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
            weights are those of another architecture.
    """
    file = Path(file)
    weights = _weights_in(file)
    network = MaskRCNN(detectron2_config(weights))
    copy_weights(network, from_detectron2(weights), source=str(file))
    return network.eval()


def detectron2_config(weights: Mapping[str, torch.Tensor]) -> DetectorConfig:
    """Return the sizes of a network with these weights: ResNet-50 with as many kinds as they tell apart.

    Means and deviations of the pixels are taken where they are stored.

    Raises:
        CheckpointError: They are those of no Mask R-CNN.
    """
    if _KINDS not in weights:
        raise CheckpointError(f"there are no weights {_KINDS}; a Mask R-CNN of Detectron2 has them.")
    config = replace(resnet50(), num_classes=len(weights[_KINDS]) - 1)
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


def _weights_in(file: Path) -> dict[str, torch.Tensor]:
    if not file.is_file():
        raise CheckpointError(f"there is no file {file}.")
    try:
        values: Any = torch.load(file, map_location="cpu", weights_only=True)  # Any: whatever it holds
    except MemoryError:
        raise
    except Exception as error:  # a file made to do harm can fail in any way
        reason = (str(error).splitlines() or [""])[0]
        raise CheckpointError(
            f"{file} cannot be read as tensors alone ({type(error).__name__}: {reason}). Nothing in it was "
            'executed. Give a .pth file of torch; of a training checkpoint, save the entry "model" alone.'
        ) from error
    values = values.get("model", values) if isinstance(values, Mapping) else values
    if not isinstance(values, Mapping) or not values:
        raise CheckpointError(f"{file} holds a {type(values).__name__}; weights by name are needed.")
    tensors = {
        str(name): torch.from_numpy(value) if isinstance(value, np.ndarray) else value
        for name, value in values.items()
    }
    if others := [name for name, value in tensors.items() if not isinstance(value, torch.Tensor)]:
        raise CheckpointError(f"{file} holds more than weights: {', '.join(others[:5])}.")
    return tensors
