"""Experiments with openvima-small: variants, their differences over seeds."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest

pytest.importorskip("torch")

from ablations import VARIANTS, Recorded, attribute_table, differences_table, read_rows, settings_of, solved
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.statistics import PairCounts, difference_over_seeds
from openvima.policies.build import policy_size
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
    solved_of = {
        ("full", 0): 8,
        ("full", 1): 6,
        ("no-coreference", 0): 5,
        ("no-coreference", 1): 5,
        ("no-rotation", 1): 9,
    }
    for (name, seed), count in solved_of.items():
        outcomes = {"L1": {"twist": f"{'1' * count:0<{EPISODES}}"}}
        row = {"variant": name, "what": name.replace("-", " "), "seed": seed, "solved": outcomes}
        (tmp_path / f"{name}-{seed}.json").write_text(json.dumps(row))
    lines = differences_table(read_rows(tmp_path)).splitlines()
    rows = {line.split(" | ")[0].strip("| "): line for line in lines if line.startswith("| ")}
    assert "70.0" in rows["full"] and "+" not in rows["full"]
    difference, interval = difference_over_seeds([[PairCounts(5, 0, 3, 2)], [PairCounts(5, 0, 1, 4)]])
    assert f"−{-100 * difference:.1f}" in rows["no coreference"]
    assert f"{100 * interval[1]:.1f}" in rows["no coreference"]
    assert "+30.0" in rows["no rotation"]  # of the seed that both have


def test_attributes_are_shown_where_both_were_trained() -> None:
    with_them = {"L3": {"same_shape": "11"}, "L4": {"same_texture": "11", "follow_motion": "10"}}
    without = {"L3": {"same_shape": "10"}, "L4": {"same_texture": "00", "follow_motion": "10"}}
    full = Recorded("full model", "full", {0: with_them})
    assert attribute_table({"full": full}) == ""
    found = {"full": full, "no-attributes": Recorded("no attributes", "full", {0: without})}
    lines = attribute_table(found).splitlines()
    cells = {line.split(" | ")[0].strip("| "): line.split(" | ")[1:] for line in lines if " | " in line}
    assert [cell.split()[0] for cell in cells["with attributes"]] == ["1", "100.0", "50.0", "75.0", "100.0"]
    assert [cell.split()[0] for cell in cells["without"]] == ["1", "0.0", "50.0", "25.0", "50.0"]
