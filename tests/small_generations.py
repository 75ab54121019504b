"""Small data sets that the oracle plays for tests of generating."""

from dataclasses import replace
from pathlib import Path

from openvima.data import GenerateConfig

TASKS = ("rotate", "sweep_without_exceeding")


def config(out: Path, **changes: object) -> GenerateConfig:
    """Three episodes of two tasks, in shards of two."""
    return replace(GenerateConfig(out=out, tasks=TASKS, episodes=3, shard_size=2), **changes)
