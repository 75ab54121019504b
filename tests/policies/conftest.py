"""One thread, so that sums do not depend on the machine, and episodes for policies to play."""

from collections.abc import Iterator
from importlib.util import find_spec

import pytest

from openvima.env import TabletopEnv


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    if find_spec("torch") is None:
        yield
        return
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def envs() -> list[TabletopEnv]:
    """Four environments with a fresh episode each, of prompts and tables of different size."""
    tasks = ("visual_manipulation", "rotate", "sweep_without_exceeding", "visual_manipulation")
    made = [TabletopEnv(task) for task in tasks]
    for seed, env in enumerate(made):
        env.reset(seed=seed)
    return made
