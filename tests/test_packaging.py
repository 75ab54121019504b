"""What a wheel holds besides code."""

import shutil
import zipfile
from pathlib import Path

import pytest

import openvima

ROOT = Path(__file__).parents[1]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """The project with little code, and with a trained detector in it."""
    pytest.importorskip("hatchling", reason="hatchling builds the wheels")
    for name in ("pyproject.toml", "README.md", "LICENSE", ".gitignore"):
        shutil.copy(ROOT / name, tmp_path / name)
    package, trained = tmp_path / "src" / "openvima", tmp_path / "src" / "openvima" / "detection" / "trained"
    trained.mkdir(parents=True)
    shutil.copy(Path(openvima.__file__), package)
    for name in ("model.safetensors", "config.yaml"):
        (trained / name).write_text("weights")
    return tmp_path


def test_a_wheel_holds_the_trained_detector(project: Path, tmp_path: Path) -> None:
    from hatchling.builders.wheel import WheelBuilder

    (wheel,) = WheelBuilder(str(project)).build(directory=str(tmp_path / "dist"), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    trained = {f"openvima/detection/trained/{name}" for name in ("model.safetensors", "config.yaml")}
    assert trained <= names


def test_a_detector_in_the_package_is_small_and_can_be_loaded() -> None:
    pytest.importorskip("torch")
    from openvima.detection import PACKAGED, load_detector

    assert {file.name for file in PACKAGED.iterdir()} == {"model.safetensors", "config.yaml"}
    assert sum(file.stat().st_size for file in PACKAGED.iterdir()) <= 8e6
    assert load_detector().network.config
