"""Recorded actions of the public benchmark, replayed with our physics and the original asset pack.

The recordings and the pack are no part of the project; OPENVIMA_GOLDEN and OPENVIMA_REFERENCE_ASSETS name
their folders. Tolerances: the benchmark's arm stops up to 2 mm beside its targets and its spatula 2 to 4 mm
early; stacks and pushed crowds are chaotic, hence medians.
"""

import os
from functools import cache
from pathlib import Path

import pytest

from dynamics import StepDifference, read_steps, replay, summary
from openvima.catalog.original import OriginalAssets

FOLDER = Path(os.environ.get("OPENVIMA_GOLDEN", "../shared/golden")) / "dynamics"
EPISODES = (FOLDER / "episodes.json.gz", FOLDER / "episodes_extra.json.gz")
ASSETS = Path(os.environ.get("OPENVIMA_REFERENCE_ASSETS", "../shared/reference_assets"))

pytestmark = [
    pytest.mark.skipif(not EPISODES[1].is_file(), reason=f"{EPISODES[1]} is absent; set OPENVIMA_GOLDEN"),
    pytest.mark.skipif(not ASSETS.is_dir(), reason=f"{ASSETS} is absent; set OPENVIMA_REFERENCE_ASSETS"),
]


@cache
def differences() -> dict[str, list[StepDifference]]:
    assets = OriginalAssets(ASSETS)
    found: dict[str, list[StepDifference]] = {"oracle": [], "perturbed": []}
    for file in EPISODES:
        for step in read_steps(file):
            found[step.mode].append(replay(step, assets))
    return found


@pytest.mark.parametrize(("mode", "same_moved"), [("oracle", 0.99), ("perturbed", 0.95)])
def test_golden_objects_are_moved_placed_and_swept_as_in_the_benchmark(mode, same_moved) -> None:
    result = summary(differences()[mode])
    assert result["same_moved"] >= same_moved
    assert result["place_error_mm_median"] <= 3.0
    assert result["yaw_error_deg_median"] <= 2.0
    assert result["sweep_error_mm_median"] <= 15.0


def test_golden_picks_lift_the_same_objects() -> None:
    steps = [*differences()["oracle"], *differences()["perturbed"]]
    carried = [body for step in steps for body in step.bodies if body.is_carried]
    assert len(carried) > 100
    assert all(body.moved_there or body.apart_m < 0.005 for body in carried)
