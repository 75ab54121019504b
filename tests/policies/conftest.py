"""Short demonstrations by the oracle and small networks, on one thread."""

from dataclasses import replace

import pytest

from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from small_networks import narrow, one_thread

__all__ = ["one_thread"]

TASKS = ("visual_manipulation", "rotate", "sweep_without_exceeding")


@pytest.fixture(scope="session")
def starts() -> list[tuple[TabletopEnv, dict]]:
    """Environments after reset, with their observations; not to be stepped."""
    envs = [TabletopEnv(task) for task in TASKS]
    return [(env, env.reset(seed=seed)[0]) for seed, env in enumerate(envs)]


@pytest.fixture(scope="session")
def demonstrations() -> list[Demonstration]:
    """Two of each task, of one step and of several."""
    runs = []
    for task in TASKS:
        env = TabletopEnv(task, level="train", domain="user")
        runs += [rollout_oracle(env, seed) for seed in range(2)]
    long = next(
        run for seed in range(100) if (run := rollout_oracle(env, seed)).num_steps > 1 and run.outcome.success
    )
    return [*runs, long]


@pytest.fixture(scope="session")
def small_sizes():
    """A nano network that is narrower and shallower."""
    return narrow("nano")


@pytest.fixture(scope="session")
def small_bins_sizes():
    """The same with the bins head."""
    sizes = narrow("nano-bins")
    return replace(sizes, head=replace(sizes.head, hidden_width=32))
