"""Checkpoints of detectors, and files of Detectron2."""

import re
from dataclasses import replace

import pytest
import torch
import yaml

from openvima.detector import load_detector
from openvima.detector.checkpoint import (
    detectron2_config,
    from_detectron2,
    load_detectron2,
    load_network,
    save_network,
)
from openvima.detector.config import RESNET50, BackboneConfig, DetectorConfig, detector_config
from openvima.detector.network import MaskRCNN
from openvima.errors import ConfigError, InputFileError


def detectron2_layout(num_classes: int = 1) -> dict[str, tuple[int, ...]]:
    """Names and shapes of Detectron2's Mask R-CNN R50-FPN, written down from its architecture."""
    shapes: dict[str, tuple[int, ...]] = {}

    def conv_norm(name: str, out: int, inputs: int, kernel: int) -> None:
        shapes[f"{name}.weight"] = (out, inputs, kernel, kernel)
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.norm.{part}"] = (out,)

    def layer(name: str, out: int, *rest: int) -> None:
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (out, *rest), (out,)

    conv_norm("backbone.bottom_up.stem.conv1", 64, 3, 7)
    inputs = 64
    for stage, (blocks, inner) in enumerate(((3, 64), (4, 128), (6, 256), (3, 512)), start=2):
        for block in range(blocks):
            name = f"backbone.bottom_up.res{stage}.{block}"
            if block == 0:
                conv_norm(f"{name}.shortcut", 4 * inner, inputs, 1)
            conv_norm(f"{name}.conv1", inner, inputs, 1)
            conv_norm(f"{name}.conv2", inner, inner, 3)
            conv_norm(f"{name}.conv3", 4 * inner, inner, 1)
            inputs = 4 * inner
        layer(f"backbone.fpn_lateral{stage}", 256, inputs, 1, 1)
        layer(f"backbone.fpn_output{stage}", 256, 256, 3, 3)
    layer("proposal_generator.rpn_head.conv", 256, 256, 3, 3)
    layer("proposal_generator.rpn_head.objectness_logits", 3, 256, 1, 1)
    layer("proposal_generator.rpn_head.anchor_deltas", 12, 256, 1, 1)
    layer("roi_heads.box_head.fc1", 1024, 256 * 49)
    layer("roi_heads.box_head.fc2", 1024, 1024)
    layer("roi_heads.box_predictor.cls_score", num_classes + 1, 1024)
    layer("roi_heads.box_predictor.bbox_pred", 4 * num_classes, 1024)
    for number in range(1, 5):
        layer(f"roi_heads.mask_head.mask_fcn{number}", 256, 256, 3, 3)
    shapes["roi_heads.mask_head.deconv.weight"] = (256, 256, 2, 2)
    shapes["roi_heads.mask_head.deconv.bias"] = (256,)
    layer("roi_heads.mask_head.predictor", num_classes, 256, 1, 1)
    return shapes


@pytest.fixture(scope="module")
def foreign() -> dict[str, torch.Tensor]:
    """Random weights of that layout, with what else such files hold."""
    generator = torch.Generator().manual_seed(0)
    weights = {
        name: torch.randn(shape, generator=generator) * 0.02 for name, shape in detectron2_layout(2).items()
    }
    for name in weights:
        if name.endswith(("norm.weight", "running_var")):
            weights[name] = weights[name].abs() + 1
    weights["pixel_mean"] = torch.tensor([100.0, 110.0, 120.0]).view(3, 1, 1)
    weights["pixel_std"] = torch.tensor([57.0, 58.0, 59.0]).view(3, 1, 1)
    weights["proposal_generator.anchor_generator.cell_anchors.0"] = torch.zeros(3, 4)
    return weights


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
    for name in ("small", "resnet50"):
        config = detector_config(name)
        assert DetectorConfig.from_dict(yaml.safe_load(yaml.safe_dump(config.to_dict()))) == config
    with pytest.raises(ConfigError, match="Did you mean 'small'"):
        detector_config("smal")
    with pytest.raises(ConfigError, match="unknown fields colour"):
        DetectorConfig.from_dict({**detector_config("small").to_dict(), "colour": 1})
    backbone = BackboneConfig("basic", (1, 1), (8,), 8, 3, 16)
    with pytest.raises(ConfigError, match=r"depths has 2 stages.*anchor_sizes 2 numbers"):
        DetectorConfig(backbone, (1.0, 2.0))


def test_the_layout_of_detectron2_is_that_of_ours_name_by_name(foreign):
    config = detectron2_config(foreign)
    assert config == replace(
        RESNET50, num_classes=2, pixel_mean=(100.0, 110.0, 120.0), pixel_std=(57.0, 58.0, 59.0)
    )
    with torch.device("meta"):
        expected = MaskRCNN(config).state_dict()
    given = from_detectron2(foreign)
    expected = {name: tensor for name, tensor in expected.items() if "num_batches" not in name}
    assert {name: tensor.shape for name, tensor in given.items()} == {
        name: tensor.shape for name, tensor in expected.items()
    }
    block = "backbone.bottom_up.res4.3.conv2"
    assert torch.equal(given["backbone.stages.2.3.layers.1.conv.weight"], foreign[f"{block}.weight"])
    assert torch.equal(given["backbone.stages.2.3.layers.1.norm.bias"], foreign[f"{block}.norm.bias"])
    assert torch.equal(given["backbone.lateral.3.weight"], foreign["backbone.fpn_lateral5.weight"])


def test_what_is_no_such_file_is_refused(tiny, tmp_path):
    with pytest.raises(InputFileError, match="no file"):
        load_detectron2(tmp_path / "none.pth")
    torch.save({"model": MaskRCNN(tiny).state_dict()}, tmp_path / "ours.pth")
    with pytest.raises(InputFileError, match="Mask R-CNN of Detectron2"):
        load_detectron2(tmp_path / "ours.pth")
    torch.save({"model": re.compile("x")}, tmp_path / "code.pth")
    with pytest.raises(InputFileError, match="Nothing in it was executed"):
        load_detectron2(tmp_path / "code.pth")
    torch.save({"model": {"weight": 1.0}}, tmp_path / "number.pth")
    with pytest.raises(InputFileError, match="no weights by name"):
        load_detectron2(tmp_path / "number.pth")


def test_missing_weights_are_told(foreign, tmp_path):
    fewer = {name: tensor for name, tensor in foreign.items() if "mask_fcn2" not in name}
    torch.save(fewer, tmp_path / "part.pth")
    with pytest.raises(InputFileError, match=r"missing: mask_head.convs.1.weight, mask_head.convs.1.bias"):
        load_detectron2(tmp_path / "part.pth")
