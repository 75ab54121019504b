"""VIMA-Gato with the tiny golden weights, stage by stage."""

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

NAME = "gato_tiny"
pytestmark = needs(NAME)


@pytest.fixture(scope="module")
def recorded() -> Recording:
    return recording(NAME)


@pytest.fixture(scope="module")
def computed(recorded: Recording) -> Arrays:
    return stages(tiny_network(NAME), recorded)


@pytest.mark.parametrize("name", recorded_names(NAME))
def test_golden_gato_agrees_in(name: str, computed: Arrays, recorded: Recording):
    assert_agrees(computed[name], recorded[name])


@pytest.mark.usefixtures("computed")
def test_golden_gato_is_fed_every_input(recorded: Recording):
    assert recorded.unused_inputs() == []
