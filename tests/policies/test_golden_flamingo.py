"""VIMA-Flamingo with the tiny golden weights, stage by stage.

The resampler's tokens reach 40 here and the first cross block's outputs 64, so rounding shows most in this
one: two runs of the published code differ by up to 2.6e-4 after the last cross block. On one thread this one
differs from the recording by 4.2e-5 at most.
"""

import pytest

pytest.importorskip("torch")

from tests.policies.golden import (
    Arrays,
    Recording,
    assert_agrees,
    needs,
    recorded_names,
    recording,
    tiny_network,
)
from tests.policies.golden_stages import stages

NAME = "flamingo_tiny"
pytestmark = needs(NAME)


@pytest.fixture(scope="module")
def recorded() -> Recording:
    return recording(NAME)


@pytest.fixture(scope="module")
def computed(recorded: Recording) -> Arrays:
    return stages(tiny_network(NAME), recorded)


@pytest.mark.parametrize("name", recorded_names(NAME))
def test_golden_flamingo_agrees_in(name: str, computed: Arrays, recorded: Recording):
    assert_agrees(computed[name], recorded[name])


@pytest.mark.usefixtures("computed")
def test_golden_flamingo_is_fed_every_input(recorded: Recording):
    assert recorded.unused_inputs() == []
