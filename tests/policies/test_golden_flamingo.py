"""VIMA-Flamingo with the tiny golden weights, stage by stage.

The resampler's tokens reach 40 here and the first cross block's outputs 64, so rounding shows most in this
one: two runs of the published code differ by up to 2.6e-4 after the last cross block. On one thread this one
differs from the recording by 4.2e-5 at most.
"""

import pytest

pytest.importorskip("torch")

from tests.policies.golden import (
    Arrays,
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
def recorded() -> Arrays:
    return recording(NAME)


@pytest.fixture(scope="module")
def computed(recorded: Arrays) -> Arrays:
    return stages(tiny_network(NAME), recorded)


@pytest.mark.parametrize("name", recorded_names(NAME))
def test_golden_flamingo_agrees_in(name: str, computed: Arrays, recorded: Arrays):
    assert_agrees(computed[name], recorded[name])
