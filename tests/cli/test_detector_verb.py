"""The verb `detector`, and `--boxes detector` of evaluate and demo."""

import json
import re
from pathlib import Path

import pytest
from PIL import Image

torch = pytest.importorskip("torch")
pytest.importorskip("pycocotools")

from openvima.cli.main import main  # noqa: E402
from openvima.data import GenerateConfig, generate  # noqa: E402
from openvima.detector import config as sizes  # noqa: E402
from openvima.detector.checkpoint import load_network, save_network  # noqa: E402
from openvima.detector.config import BackboneConfig, DetectorConfig  # noqa: E402
from openvima.detector.network import MaskRCNN  # noqa: E402


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    return generate(GenerateConfig(out=folder / "demos", tasks=("rotate",), episodes=8))


@pytest.fixture
def tiny() -> DetectorConfig:
    """Sizes of a detector that trains in moments."""
    backbone = BackboneConfig("basic", (1,), (8,), stem_width=4, stem_kernel=3, fpn_width=8)
    heads = {"box_head_widths": (8,), "mask_head_widths": (8,)}
    return DetectorConfig(backbone, (32.0,), **heads, rpn_post_nms_top_n=4, rpn_pre_nms_top_n=8)


@pytest.fixture
def detector(tiny, tmp_path) -> Path:
    torch.manual_seed(0)
    save_network(MaskRCNN(tiny), tmp_path / "detector")
    return tmp_path / "detector"


@pytest.mark.slow
def test_evaluate_and_show_accept_a_training_run(data, tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sizes.DETECTORS, "small", tiny)
    run = tmp_path / "run"
    words = f"--data {data} --out {run} --schedule.steps 1 --loader.batch-size 2 --runtime.device cpu"
    words += " --loader.validation-fraction 0.4 --loader.validation-frames 2"
    assert main(["detector", "train", *words.split()]) == 0
    assert capsys.readouterr().out == f"{run}\n"
    assert load_network(run).config == tiny
    words = [str(run), "--data", str(data), "--frames", "4", "--held-out", "0.4", "--json"]
    assert main(["detector", "evaluate", *words]) == 0
    score = json.loads(capsys.readouterr().out)
    assert (score["detector"], score["data"], score["held_out"]) == (str(run), str(data), 0.4)
    assert score["frames"] == 4 and 0 <= score["boxes"]["ap50"] <= 1
    image_file = tmp_path / "seen.png"
    words = [str(run), "--data", str(data), "--frames", "2", "--out", str(image_file)]
    assert main(["detector", "show", *words]) == 0
    with Image.open(image_file) as shown:
        assert shown.size[0] > 2 * 256


def test_frames_of_a_level_are_generated_without_a_folder(detector, capsys):
    assert main(["detector", "evaluate", str(detector), "--level", "L4", "--frames", "2"]) == 0
    table = capsys.readouterr().out
    assert "AP50" in table and "boxes" in table and "masks" in table


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--data", "DATA", "--held-out", "0"], "no demonstrations to evaluate on"),
        (["--data", "DATA", "--held-out", "1.5"], "held-out is 1.5"),
        (["--data", "DATA", "--level", "L3"], "leave one of them out"),
        (["--data", "nowhere"], "there is no folder nowhere"),
        (["--held-out", "0.1", "--frames", "0"], r"frames is 0; .* no data are given"),
        (["--level", "L9"], "no level 'L9'"),
        (["--seed", "-1"], "seed is -1"),
        (["--device", "abacus"], "device 'abacus' cannot be used here"),
    ],
)
def test_invalid_options_of_evaluate_give_a_one_line_error(detector, data, capsys, words, message):
    words = [str(data) if word == "DATA" else word for word in words]
    assert main(["detector", "evaluate", str(detector), *words]) == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert re.search(message, told)


def test_convert_writes_a_folder_once(tiny, tmp_path, monkeypatch, capsys):
    from openvima.detector import checkpoint

    monkeypatch.setattr(checkpoint, "load_detectron2", lambda file: MaskRCNN(tiny))
    words = ["detector", "convert", "weights.pth", str(tmp_path / "converted")]
    assert main(words) == 0
    assert load_network(tmp_path / "converted").config == tiny
    assert main(words) == 2
    assert "exists" in capsys.readouterr().err
    assert main([*words, "--force"]) == 0


def test_a_missing_detector_gives_a_one_line_error(tmp_path, capsys):
    assert main(["detector", "show", str(tmp_path / "none")]) == 2
    assert "there is no folder" in capsys.readouterr().err
    assert main(["detector", "show", "--out", "seen.jpg"]) == 2
    assert ".png" in capsys.readouterr().err


def test_evaluate_plays_with_the_boxes_of_a_trained_detector(detector, tmp_path, capsys):
    words = ["--policy", "untrained", "--tasks", "rotate", "--levels", "L1", "--episodes", "1"]
    more = ["--boxes", f"detector={detector}", "--out", str(tmp_path / "out"), "--no-report", "--json"]
    assert main(["evaluate", *words, *more]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row.get("ablation", "") for row in rows] == ["", "detected_boxes"]
