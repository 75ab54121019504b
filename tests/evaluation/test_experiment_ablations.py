"""`experiments/openvima_small/ablations.py`: variants that differ, and their differences over seeds."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest

pytest.importorskip("torch")

from ablations import VARIANTS, differences_table, settings_of, solved
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.statistics import PairCounts, difference_over_seeds
from openvima.policies.parameter_counts import policy_size
from openvima.policies.pointer.config import small
from openvima.policies.variants import with_variant
from openvima.training import TrainingConfig

EPISODES = 10


def test_every_variant_differs_from_its_baseline_and_all_fit() -> None:
    def resolved(name: str) -> tuple:
        config = TrainingConfig.of({**settings_of(name, "small"), "data": Path(), "out": Path()})
        return with_variant(VARIANTS[name].change(small()), asdict(config.model)), config.identity()

    for name, variant in VARIANTS.items():
        assert policy_size(resolved(name)[0]).parameters.total < 10_000_000
        assert (resolved(name) == resolved(variant.baseline)) == (name == variant.baseline)


def test_solved_episodes_are_in_the_order_of_seeds() -> None:
    outcomes = tuple(EpisodeOutcome(seed, seed == 7, 1) for seed in (6, 7, 8))
    rows = [Row("policy", task, level, 1, outcomes) for task, level in (("twist", "L1"), ("rotate", "L2"))]
    assert solved(Results(tuple(rows), {}, {}, {"policy": {}})) == {
        "L1": {"twist": "010"},
        "L2": {"rotate": "010"},
    }


def test_differences_are_over_the_seeds_of_both(tmp_path: Path) -> None:
    for name, count in {
        "full": 8,
        "full-seed-1": 6,
        "no-coreference": 5,
        "no-coreference-seed-1": 5,
        "no-rotation-seed-1": 9,
    }.items():
        content = {"solved": {"L1": {"twist": f"{'1' * count:0<{EPISODES}}"}}}
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    lines = differences_table(tmp_path, [0, 1]).splitlines()
    rows = {line.split(" | ")[0].strip("| "): line for line in lines if line.startswith("| ")}
    assert "70.0" in rows["full model"] and "+" not in rows["full model"]
    difference, interval = difference_over_seeds([[PairCounts(5, 0, 3, 2)], [PairCounts(5, 0, 1, 4)]])
    assert f"−{-100 * difference:.1f}" in rows["no coreference"]
    assert f"{100 * interval[1]:.1f}" in rows["no coreference"]
    assert "+30.0" in rows["no relative rotation"]  # of the seed that both have
