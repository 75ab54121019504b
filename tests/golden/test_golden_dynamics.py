"""Recorded actions of the public benchmark, replayed with our physics and the original asset pack.

The recordings and the pack are no part of the project; OPENVIMA_GOLDEN and OPENVIMA_REFERENCE_ASSETS name
their folders. Tolerances: the benchmark's arm stops up to 2 mm beside its targets and its blade 2 to 4 mm
early and up to 2 mm beside a straight line, while ours are exact; stacks and pushed crowds are chaotic, hence
medians.
"""

import os
from functools import cache
from pathlib import Path

import pytest

from golden_episodes import Difference, read_steps, replay, summary
from openvima.catalog.original import OriginalAssets

EPISODES = Path(os.environ.get("OPENVIMA_GOLDEN", "../shared/golden")) / "dynamics" / "episodes.json.gz"
ASSETS = Path(os.environ.get("OPENVIMA_REFERENCE_ASSETS", "../shared/reference_assets"))

pytestmark = [
    pytest.mark.skipif(not EPISODES.is_file(), reason=f"{EPISODES} is absent; set OPENVIMA_GOLDEN"),
    pytest.mark.skipif(not ASSETS.is_dir(), reason=f"{ASSETS} is absent; set OPENVIMA_REFERENCE_ASSETS"),
]


@cache
def differences() -> dict[str, list[Difference]]:
    assets = OriginalAssets(ASSETS)
    found: dict[str, list[Difference]] = {"oracle": [], "perturbed": []}
    for step in read_steps(EPISODES):
        found[step.mode] += replay(step, assets)
    return found


@pytest.mark.parametrize(("mode", "same_moved"), [("oracle", 0.98), ("perturbed", 0.95)])
def test_golden_actions_move_the_same_bodies(mode, same_moved) -> None:
    assert summary(differences()[mode])["same_moved"] >= same_moved


@pytest.mark.parametrize(("mode", "millimetres", "degrees"), [("oracle", 2.0, 0.5), ("perturbed", 2.5, 1.0)])
def test_golden_objects_are_placed_where_the_benchmark_places_them(mode, millimetres, degrees) -> None:
    result = summary(differences()[mode])
    assert result["place_error_mm_median"] <= millimetres
    assert result["yaw_error_deg_median"] <= degrees


@pytest.mark.parametrize("mode", ["oracle", "perturbed"])
def test_golden_blocks_are_swept_to_where_the_benchmark_sweeps_them(mode) -> None:
    assert summary(differences()[mode])["sweep_error_mm_median"] <= 5.0


def test_golden_picks_lift_the_same_objects() -> None:
    lifted = [d for d in (*differences()["oracle"], *differences()["perturbed"]) if d.is_lifted]
    assert len(lifted) > 100
    assert all(difference.moved for difference in lifted)
