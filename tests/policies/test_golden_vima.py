"""VIMA with the tiny golden weights, stage by stage and in a closed loop; tables of bins and of distances."""

import numpy as np
import pytest
import torch
from tests.policies.golden import (
    Arrays,
    Recording,
    assert_close_to_golden,
    needs,
    recorded_names,
    recording,
    tiny_network,
)
from tests.policies.golden_stages import closed_loop, stages

from openvima.policies.nn.action_head import NUM_BINS, encode_bins
from openvima.policies.nn.prompt_encoder import relative_bucket

NAME = "vima_tiny"
pytestmark = needs(NAME)


@pytest.fixture(scope="module")
def recorded() -> Recording:
    return recording(NAME)


@pytest.fixture(scope="module")
def computed(recorded: Recording) -> Arrays:
    network = tiny_network(NAME)
    return stages(network, recorded) | closed_loop(network, recorded) | tables(recorded)


def tables(recorded: Arrays) -> Arrays:
    """Buckets of distances, bins of values, and the arguments of both."""
    distances, values = recorded["table.t5_relative_position"], recorded["table.value"]
    bins = encode_bins(torch.from_numpy(values)[:, None].expand(-1, len(NUM_BINS))).numpy()
    return {
        "table.t5_relative_position": distances,
        "table.t5_bucket": relative_bucket(torch.from_numpy(distances)).numpy(),
        "table.value": values,
        "table.bin_x": bins[:, 0],
        "table.bin_y": bins[:, 1],
        "table.bin_rot": bins[:, 2],
    }


def within_table(name: str, bins: np.ndarray) -> np.ndarray:
    """Values above 1 fall into the last bin here; the published code gives them one that does not exist."""
    component = {"table.bin_x": 0, "table.bin_y": 1, "table.bin_rot": 2}.get(name)
    return bins if component is None else np.minimum(bins, NUM_BINS[component] - 1)


@pytest.mark.parametrize("name", recorded_names(NAME))
def test_golden_vima_agrees_in(name: str, computed: Arrays, recorded: Recording):
    assert_close_to_golden(computed[name], within_table(name, recorded[name]))


@pytest.mark.usefixtures("computed")
def test_golden_vima_is_fed_every_input(recorded: Recording):
    assert recorded.unused_inputs() == []


def test_golden_closed_loop_acts_alike_with_and_without_kept_keys(computed: Arrays, recorded: Arrays):
    """What was recorded of a step repeats all steps before it; the last is what the policy acted from."""
    for t in range(len(recorded["in.ee"])):
        again = computed[f"roll.step{t}.pred_tokens"][-1]
        assert_close_to_golden(computed[f"roll.step{t}.pred_token"], again, tolerance=1e-5)
