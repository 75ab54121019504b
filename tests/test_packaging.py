"""What is published: wheels, versions, workflows and the pages that name them."""

import ast
import importlib
import re
import shutil
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

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

    folder = BUNDLED[name]
    files = [file for file in folder.rglob("*") if file.is_file()]
    names = {file.relative_to(folder).as_posix() for file in files}
    assert {name for name in names if not name.startswith("training/tuned/")} == POLICY_FILES
    assert sum(file.stat().st_size for file in files) <= most_bytes
    assert "TODO" not in (folder / "MODEL_CARD.md").read_text(encoding="utf-8")


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


SOURCE = ROOT / "src"
ROW = re.compile(r"^\| [^|]+ \| `([^`]+)` \| `([\w.]+)` \|", re.MULTILINE)
PAGE = dict(reversed(pair) for pair in ROW.findall((ROOT / "docs" / "versions.md").read_text("utf-8")))


@pytest.mark.parametrize("name", PAGE)
def test_the_page_has_the_version_of_the_code(name: str) -> None:
    module, _, constant = name.rpartition(".")
    try:
        value = getattr(importlib.import_module(module), constant)
    except ImportError as error:
        pytest.skip(f"{module} needs {error.name}")
    assert PAGE[name] == str(value)


def test_the_page_has_every_version_of_the_code() -> None:
    found = {"openvima.__version__"}
    for file in SOURCE.rglob("*.py"):
        module = ".".join(file.relative_to(SOURCE).with_suffix("").parts)
        for node in ast.parse(file.read_text("utf-8")).body:
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
                names = [target.id for target in node.targets if isinstance(target, ast.Name)]
                found |= {
                    f"{module}.{n}" for n in names if re.fullmatch(r"(\w+_)?(VERSION|SCHEMA|PROTOCOL)", n)
                }
    assert found == set(PAGE)


def test_all_files_name_the_same_version_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    plugin = tomllib.loads((ROOT / "plugins/lerobot/pyproject.toml").read_text("utf-8"))["project"]
    assert project["version"] == plugin["version"] == citation["version"] == openvima.__version__


def test_workflows_cover_the_pythons_that_are_promised_and_store_no_token() -> None:
    workflows = {file.name: file.read_text("utf-8") for file in (ROOT / ".github/workflows").glob("*.yml")}
    pythons = yaml.safe_load(workflows["ci.yml"])["jobs"]["tests"]["strategy"]["matrix"]["python"]
    page = (ROOT / "docs" / "versions.md").read_text("utf-8")
    assert f"**Python** {pythons[0]} to {pythons[-1]}" in page
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["requires-python"] == f">={pythons[0]}"
    publish = yaml.safe_load(workflows["release.yml"])["jobs"]["publish"]
    assert publish["permissions"] == {"id-token": "write"}
    assert publish["needs"] == "build"
    assert not any("secrets." in text for text in workflows.values())
    scripts = {word for text in workflows.values() for word in re.findall(r"run: (\.ci/\w+)", text)}
    assert scripts == {".ci/run", ".ci/package"}
    assert all((ROOT / script).stat().st_mode & 0o100 for script in scripts)


def test_the_container_follows_the_commands_of_the_readme() -> None:
    readme = (ROOT / "README.md").read_text("utf-8")
    container = (ROOT / "Containerfile").read_text("utf-8")
    install, tests = re.search(r"^(pip install .*\[dev\].*) && (.*)$", readme, re.MULTILINE).groups()
    assert f"RUN python3 -m venv .venv && .venv/bin/{install}\n" in container
    assert f"openvima {tests} " in container
    command = yaml.safe_load(re.search(r"^CMD (.*)$", container, re.MULTILINE)[1])
    assert f"\n{' '.join(command[:-1])} " in readme
