"""Demonstrations to preprocess."""

import shutil
from pathlib import Path

import pytest

from openvima.data import GenerateConfig, generate


@pytest.fixture(scope="package")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five demonstrations of each of two tasks, in shards of two."""
    out = tmp_path_factory.mktemp("object_cache") / "demos"
    return generate(
        GenerateConfig(out=out, tasks=("rotate", "rearrange_then_restore"), episodes=5, shard_size=2)
    )


@pytest.fixture
def copy(demos: Path, tmp_path: Path) -> Path:
    """A copy without an object cache, to be changed."""
    shutil.copytree(demos, tmp_path / "demos", ignore=shutil.ignore_patterns("object_cache"))
    return tmp_path / "demos"
