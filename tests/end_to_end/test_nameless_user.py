"""Users without a passwd entry and without a home, as containers have them, from assets to a training."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("torch")

NAMELESS = 12345  # a user id that no system gives
PROGRAM = """
import os, pwd, sys

def unknown(uid):
    raise KeyError(f"getpwuid(): uid not found: {uid}")

pwd.getpwuid = unknown
from openvima.cli.main import main

for words in (
    "assets info",
    "evaluate --policy oracle --tasks rotate --levels L1 --episodes 1 --workers 1 --no-report --out scores",
    "generate --tasks rotate --episodes 8 --workers 1 --out demos",
    "train --data demos --preset nano --schedule.steps 2 --schedule.warmup-steps 1 --pretraining.steps 0"
    " --loader.batch-size 2 --loader.validation-episodes 2 --runtime.device cpu --out run",
):
    if status := main(words.split()):
        sys.exit(f"{words}: {status}")
"""


def may_be_read_by_all(path: Path) -> bool:
    return all(folder.stat().st_mode & 0o005 == 0o005 for folder in (path, *path.parents))


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that every user may enter, unlike those of pytest."""
    made = Path(tempfile.mkdtemp())
    made.chmod(0o777)
    yield made
    shutil.rmtree(made)


@pytest.mark.slow
@pytest.mark.parametrize("user", [None, NAMELESS])
def test_a_user_without_name_and_home_gets_from_assets_to_a_training(user: int | None, folder: Path) -> None:
    code = Path(sys.modules["torch"].__file__ or "").parent, Path(__file__).parents[2] / "src"
    if user is not None and not (os.getuid() == 0 and all(map(may_be_read_by_all, code))):
        pytest.skip("takes root, and an environment that others may read")
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("HOME", "XDG", "OPENVIMA"))
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=folder,
        env={**kept, "TMPDIR": str(folder)},
        user=user,
        group=user,
        extra_groups=None if user is None else [],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert {"scores", "demos", "run"} <= {path.name for path in folder.iterdir()}
    assert not (folder / "~").exists()
