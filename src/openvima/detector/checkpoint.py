"""Checkpoints of detectors: folders with `model.safetensors` and `config.yaml`, and files of Detectron2.

Those of Detectron2 are Mask R-CNNs with ResNet-50 and FPN, such as VIMA's detector. Only tensors and plain
values are read; nothing in the file is executed. Preprocessing and thresholds are Detectron2's defaults: BGR,
shorter side 800 pixels.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
import yaml

from openvima import __version__
from openvima.atomic_io import atomic_folder, atomic_write_file, restore_folder
from openvima.detector.config import RESNET50, DetectorConfig
from openvima.detector.network import MaskRCNN
from openvima.errors import ConfigError, InputFileError
from openvima.policies.naming import CONFIG_FILE, WEIGHTS_FILE, checkpoint_folder
from openvima.policies.nn.layers import MetaInit
from openvima.policies.tensor_files import (
    check_finite,
    check_replaceable,
    mismatches,
    read_archive,
    read_description,
    read_safetensors,
    write_safetensors,
)

_KIND = "detector"
_COUNTER = "num_batches_tracked"


def save_network(network: MaskRCNN, folder: str | Path) -> None:
    """Write a checkpoint folder atomically; an existing checkpoint is replaced.

    Raises:
        InputFileError: The folder contains other files.
    """
    folder = Path(folder)
    check_replaceable(folder, (WEIGHTS_FILE, CONFIG_FILE))
    with atomic_folder(folder) as partial:
        write_network(network, partial)


def write_network(network: MaskRCNN, folder: Path) -> None:
    """Write the files of a checkpoint into an existing folder."""
    tensors = {name: tensor.cpu().contiguous() for name, tensor in _tensors(network).items()}
    write_safetensors(tensors, folder / WEIGHTS_FILE)
    values = {"policy": _KIND, "openvima": __version__, "config": network.config.to_dict()}
    atomic_write_file(folder / CONFIG_FILE, yaml.safe_dump(values, sort_keys=False))


def load_network(path: str | Path) -> MaskRCNN:
    """Load a network in evaluation mode.

    Args:
        path: A checkpoint folder, or a run folder, whose best checkpoint is loaded.

    Raises:
        InputFileError: There is none, it is damaged, or weights and config do not match.
    """
    restore_folder(Path(path))
    folder = checkpoint_folder(Path(path))
    values, file = read_description(folder, _KIND), folder / WEIGHTS_FILE
    try:
        config = DetectorConfig.from_dict(values["config"])
    except ConfigError as error:
        raise InputFileError(f"{folder / CONFIG_FILE}: {error}") from error
    return build_network(config, read_safetensors(file), source=file)


def load_weights(network: MaskRCNN, file: Path) -> None:
    """Load the weights of a file into a network.

    Raises:
        InputFileError: The file is missing or damaged, or names or shapes differ.
    """
    tensors = read_safetensors(file)
    _check(network, tensors, source=file)
    network.load_state_dict(tensors, strict=False)


def build_network(config: DetectorConfig, tensors: Mapping[str, torch.Tensor], *, source: Path) -> MaskRCNN:
    """Build a network of weights, in evaluation mode.

    Raises:
        InputFileError: Config and weights do not match, or describe no network.
    """
    try:
        with MetaInit():  # takes no memory, whatever the config says
            outline = MaskRCNN(config)
    except MemoryError:
        raise
    except Exception as error:  # sizes within their limits can contradict each other in many ways
        raise InputFileError(f"the config of {source} describes no network: {error}") from error
    _check(outline, tensors, source=source)
    network = MaskRCNN(config)
    network.load_state_dict(tensors, strict=False)
    return network.eval()


def _check(network: MaskRCNN, tensors: Mapping[str, torch.Tensor], *, source: Path) -> None:
    if problems := mismatches(tensors, _tensors(network)):
        raise InputFileError(f"{source} does not match the config of the detector: {'; '.join(problems)}.")


def _tensors(network: MaskRCNN) -> dict[str, torch.Tensor]:
    """Return what a checkpoint holds: all but the counters of batch normalisation, which nothing uses."""
    return {name: own for name, own in network.state_dict().items() if not name.endswith(_COUNTER)}


_CLASS_WEIGHTS = "roi_heads.box_predictor.cls_score.weight"
# Names of modules in Detectron2, which nests norms in convolutions, and ours; numbers in braces.
_NAMES = """
  backbone.bottom_up.stem.conv1.norm                      backbone.stem.norm
  backbone.bottom_up.stem.conv1                           backbone.stem.conv
  backbone.bottom_up.res{stage}.{block}.shortcut.norm     backbone.stages.{stage}.{block}.shortcut.norm
  backbone.bottom_up.res{stage}.{block}.shortcut          backbone.stages.{stage}.{block}.shortcut.conv
  backbone.bottom_up.res{stage}.{block}.conv{layer}.norm  backbone.stages.{stage}.{block}.layers.{layer}.norm
  backbone.bottom_up.res{stage}.{block}.conv{layer}       backbone.stages.{stage}.{block}.layers.{layer}.conv
  backbone.fpn_lateral{stage}                             backbone.lateral.{stage}
  backbone.fpn_output{stage}                              backbone.smooth.{stage}
  proposal_generator.rpn_head.conv                        rpn.conv
  proposal_generator.rpn_head.objectness_logits           rpn.objectness
  proposal_generator.rpn_head.anchor_deltas               rpn.deltas
  roi_heads.box_head.fc{layer}                            box_head.hidden.{layer}
  roi_heads.box_predictor.cls_score                       box_head.class_logits
  roi_heads.box_predictor.bbox_pred                       box_head.deltas
  roi_heads.mask_head.mask_fcn{layer}                     mask_head.convs.{layer}
  roi_heads.mask_head.deconv                              mask_head.deconv
  roi_heads.mask_head.predictor                           mask_head.mask_logits
"""
_FIRST = {"stage": 2, "block": 0, "layer": 1}  # what Detectron2 counts from
# Constants that follow from our config, and counters without effect.
_IGNORED = re.compile(r"pixel_(mean|std)|.*anchor_generator\..*|.*num_batches_tracked")


def load_detectron2(file: str | Path) -> MaskRCNN:
    """Load a network from a Detectron2 checkpoint.

    Args:
        file: A torch file (`.pth`) with the weights by name, at top level or under "model".

    Returns:
        The network in float32, in evaluation mode.

    Raises:
        InputFileError: The file is missing, damaged or no checkpoint, it contains code, or its weights belong
            to another architecture.
    """
    file = Path(file)
    weights = _weights_in(file)
    tensors = from_detectron2(weights)
    check_finite(tensors, file)
    return build_network(detectron2_config(weights), tensors, source=file)


def detectron2_config(weights: Mapping[str, torch.Tensor]) -> DetectorConfig:
    """Return the config that matches these weights: ResNet-50 with their number of classes.

    Args:
        weights: Detectron2's state dict; `pixel_mean` and `pixel_std` are used if present.

    Raises:
        InputFileError: The weights are not a Mask R-CNN's.
    """
    if _CLASS_WEIGHTS not in weights:
        raise InputFileError(f"there are no weights {_CLASS_WEIGHTS}; a Mask R-CNN of Detectron2 has them.")
    stored = {
        name: tuple(weights[name].flatten().tolist())
        for name in ("pixel_mean", "pixel_std")
        if name in weights
    }
    return replace(RESNET50, num_classes=len(weights[_CLASS_WEIGHTS]) - 1, **stored)


def from_detectron2(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename Detectron2's weights to ours; unknown names are kept."""
    return {
        _translate_name(name): tensor.float()
        for name, tensor in weights.items()
        if not _IGNORED.fullmatch(name)
    }


def _translate_name(name: str) -> str:
    module, _, tensor = name.rpartition(".")
    for line in _NAMES.strip().splitlines():
        theirs, ours = line.split()
        if match := re.fullmatch(re.sub(r"{(\w+)}", r"(?P<\1>\\d+)", theirs), module):
            numbers = {key: int(number) - _FIRST[key] for key, number in match.groupdict().items()}
            return f"{ours.format(**numbers)}.{tensor}"
    return name


def _weights_in(file: Path) -> dict[str, torch.Tensor]:
    if not file.exists():
        raise InputFileError(f"there is no file {file}.")
    try:
        values = read_archive(file)
    except InputFileError as error:
        raise InputFileError(
            f"{error} Nothing in it was executed. Give a .pth file of torch; of a training checkpoint, save "
            'only the entry "model".'
        ) from error
    values = values.get("model", values) if isinstance(values, Mapping) else values
    if not isinstance(values, Mapping) or not all(isinstance(each, torch.Tensor) for each in values.values()):
        raise InputFileError(f"{file} contains no weights by name, or more than these.")
    return {str(name): tensor for name, tensor in values.items()}
