"""Checkpoints of detectors."""

import re

import pytest
import torch
import yaml

from openvima.detector import load_detector
from openvima.detector.checkpoint import (
    load_network,
    save_network,
)
from openvima.detector.config import BackboneConfig, DetectorConfig, detector_config
from openvima.detector.network import MaskRCNN
from openvima.errors import ConfigError, InputFileError


def test_a_detector_reads_what_it_wrote(tiny, tmp_path):
    torch.manual_seed(0)
    network = MaskRCNN(tiny).eval()
    save_network(network, tmp_path / "detector")
    again = load_network(tmp_path / "detector")
    assert again.config == tiny
    image = torch.randint(0, 256, (1, 3, 64, 96), dtype=torch.uint8)
    assert torch.equal(network(image)[0].boxes, again(image)[0].boxes)
    assert load_detector(tmp_path / "detector").network.config == tiny


def test_weights_of_other_sizes_are_refused_by_name(tiny, tmp_path):
    save_network(MaskRCNN(tiny), tmp_path / "detector")
    file = tmp_path / "detector" / "config.yaml"
    values = yaml.safe_load(file.read_text())
    values["config"]["box_head_widths"] = [33]
    file.write_text(yaml.safe_dump(values))
    with pytest.raises(InputFileError, match=re.escape("box_head.hidden.0.weight is float32 (32, 784)")):
        load_network(tmp_path / "detector")


def test_sizes_survive_a_file_and_wrong_ones_are_told():
    config = detector_config("small")
    assert DetectorConfig.from_dict(yaml.safe_load(yaml.safe_dump(config.to_dict()))) == config
    with pytest.raises(ConfigError, match="Did you mean 'small'"):
        detector_config("smal")
    with pytest.raises(ConfigError, match="unknown fields colour"):
        DetectorConfig.from_dict({**detector_config("small").to_dict(), "colour": 1})
    backbone = BackboneConfig((1, 1), (8,), 8, 3, 16)
    with pytest.raises(ConfigError, match="anchor_sizes have 2, 1, 2 numbers"):
        DetectorConfig(backbone, (1.0, 2.0))


def test_a_config_written_before_some_sizes_went_is_read():
    config = detector_config("small")
    values = {**config.to_dict(), "min_size": None, "max_size": 1333, "channel_order": "rgb"}
    values["backbone"] |= {"block": "basic", "extra_level": False}
    assert DetectorConfig.from_dict(values) == config
