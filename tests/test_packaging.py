"""What a wheel holds, and what works without extras."""

import shutil
import zipfile
from pathlib import Path

import pytest

import openvima
from openvima.errors import MissingExtraError
from openvima.imports import import_extra, lacks_memory

ROOT = Path(__file__).parents[1]
POLICY_FILES = {
    "model.safetensors",
    "config.yaml",
    "tokenizer/vocabulary.json",
    "MODEL_CARD.md",
    "training_data.json",
    *(
        f"training/{name}"
        for name in ("config.yaml", "metrics.jsonl", "sessions_log.jsonl", "timings_log.jsonl")
    ),
}
DETECTOR_FILES = {"model.safetensors", "config.yaml", "MODEL_CARD.md"}
TRAINED = {
    *(f"openvima/detector/trained/{name}" for name in DETECTOR_FILES),
    *(
        f"openvima/policies/trained/{policy}/{name}"
        for policy in ("openvima-small", "openvima-vima")
        for name in POLICY_FILES
    ),
}


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """The project with little code, and with a trained detector and a trained policy in it."""
    pytest.importorskip("hatchling", reason="hatchling builds the wheels")
    for name in ("pyproject.toml", "README.md", "LICENSE", ".gitignore"):
        shutil.copy(ROOT / name, tmp_path / name)
    package = tmp_path / "src" / "openvima"
    for file in TRAINED:
        path = package.parent / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("weights")
    shutil.copy(Path(openvima.__file__), package)
    return tmp_path


def test_a_wheel_holds_the_trained_detector_and_policy(project: Path, tmp_path: Path) -> None:
    from hatchling.builders.wheel import WheelBuilder

    (wheel,) = WheelBuilder(str(project)).build(directory=str(tmp_path / "dist"), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert names >= TRAINED


def test_a_detector_in_the_package_is_small_and_can_be_loaded() -> None:
    pytest.importorskip("torch")
    from openvima.detector import BUNDLED, load_detector

    assert {file.name for file in BUNDLED.iterdir()} == DETECTOR_FILES
    assert sum(file.stat().st_size for file in BUNDLED.iterdir()) <= 8e6
    assert load_detector().network.config


@pytest.mark.parametrize(("name", "most_bytes"), [("openvima-small", 20e6), ("openvima-vima", 8e6)])
def test_the_policies_in_the_package_are_small_and_whole(name, most_bytes) -> None:
    from openvima.policies.naming import BUNDLED

    policy = BUNDLED[name]
    files = [file for file in policy.folder.rglob("*") if file.is_file()]
    assert {file.relative_to(policy.folder).as_posix() for file in files} == POLICY_FILES
    assert sum(file.stat().st_size for file in files) <= most_bytes
    assert "TODO" not in policy.model_card.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("code", "kind", "message"),
    [
        (None, MissingExtraError, "^install it$"),
        ("import odd_package_within", MissingExtraError, "cannot be imported .*odd_package_within"),
        (
            "raise ImportError('no symbol x')",
            MissingExtraError,
            r"cannot be imported \(no symbol x\); install it",
        ),
        (
            "raise ImportError('failed to map segment from shared object')",
            MemoryError,
            "cannot be loaded",
        ),
        ("raise OSError(12, 'Cannot allocate memory')", MemoryError, "cannot be loaded"),
    ],
)
def test_only_a_missing_package_is_called_missing(
    code: str | None, kind: type[Exception], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    if code is not None:
        (tmp_path / "odd_package.py").write_text(code)
    with pytest.raises(kind, match=message):
        import_extra("odd_package", "install it")


def test_lack_of_memory_is_found_in_the_causes_of_an_exception() -> None:
    error = ValueError("no such library")
    error.__cause__ = OSError("a.so: failed to map segment from shared object")
    assert lacks_memory(error)
    assert not lacks_memory(ImportError("failed to map segment from shared object: Operation not permitted"))
    assert not lacks_memory(ValueError("memory"))
