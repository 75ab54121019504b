"""What a release and its readers rely on: versions on one page, workflows, container, issue templates."""

import ast
import importlib
import re
import tomllib
from pathlib import Path

import pytest
import yaml

import openvima

ROOT = Path(__file__).parents[1]
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
