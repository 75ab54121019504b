"""What docs/format.md says is true: its examples run without this package, and it names every column."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from openvima.data import Demonstration, ShardWriter
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import INDEX_SCHEMA
from openvima.data.schema import COLUMNS, SCHEMA_VERSION

MadeUp = Callable[..., Demonstration]
PAGE = (Path(__file__).parents[2] / "docs/format.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"^```python\n(import .*?)^```", PAGE, re.DOTALL | re.MULTILINE)
WITHOUT_PACKAGE = "import sys; sys.modules['openvima'] = None\n"


@pytest.fixture
def demos(tmp_path: Path, made_up: MadeUp, info: ShardInfo) -> Demonstration:
    """An episode in the file that the examples read, below `tmp_path`."""
    demo = made_up(7, num_steps=3)
    (tmp_path / "demos").mkdir()
    with ShardWriter(tmp_path / "demos/rotate-train-00000.arrow", info) as writer:
        writer.write(demo)
    return demo


def run(example: str, folder: Path) -> str:
    command = [sys.executable, "-c", WITHOUT_PACKAGE + example]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_an_image_and_actions_are_read_in_ten_lines(tmp_path: Path, demos: Demonstration) -> None:
    assert len(EXAMPLES[0].splitlines()) <= 12
    said = run(EXAMPLES[0], tmp_path)
    assert f"stack {demos.prompt.text}" in said
    assert "4 images" in said
    assert str([list(action.pose1_position) for action in demos.actions]) in said
    picture = (tmp_path / "first.ppm").read_bytes()
    assert picture == b"P6 256 128 255\n" + demos.rgb["top"][0].transpose(1, 2, 0).tobytes()


def test_the_content_hash_follows_from_the_file(tmp_path: Path, demos: Demonstration) -> None:
    assert run(EXAMPLES[1], tmp_path) == "True\n"


def test_the_page_names_every_column_and_the_version() -> None:
    named = set(re.findall(r"`([a-z0-9_]+)`", PAGE))
    assert {*COLUMNS.names, *INDEX_SCHEMA.names} <= named
    assert f"version of this format: {SCHEMA_VERSION} |" in PAGE
