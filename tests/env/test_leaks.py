"""Long use leaves memory and file handles as they were."""

import os
from pathlib import Path

import pytest

from openvima.env import TabletopEnv

pytestmark = pytest.mark.slow

NUM_RESETS = 400
MB = 2**20


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def num_handles() -> int:
    return len(os.listdir("/proc/self/fd"))


def test_hundreds_of_resets_leave_memory_and_file_handles_flat() -> None:
    env = TabletopEnv("novel_adj_and_noun")
    for seed in range(600):  # fills the caches of shapes, textures, hulls and models
        env.reset(seed=seed)
    before = resident_bytes(), num_handles()
    for seed in range(NUM_RESETS):
        env.reset(seed=1000 + seed)
    assert num_handles() == before[1]
    assert resident_bytes() - before[0] < 10 * MB
