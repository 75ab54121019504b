"""A short run of each attack of `benchmarks/attack_checkpoints.py`."""

import sys

import pytest

pytest.importorskip("torch")

from attack_checkpoints import ATTACKS, run

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory is read as on Linux")


@pytest.mark.parametrize("kind", [kind for kind in ATTACKS if kind != "bombs"])
def test_mutated_and_damaged_checkpoints_do_no_harm(kind: str) -> None:
    findings = run(kind, 300, seed=1)
    assert findings.problems == []
    assert findings.attacks > 15
    assert findings.loaded + findings.refused == findings.attacks


@pytest.mark.slow
def test_bombs_do_no_harm() -> None:
    findings = run("bombs", 0, seed=1)
    assert findings.problems == []
