"""Who plays the batches does not change a byte of the results: processes, Ray, batches of another size."""

from dataclasses import replace
from pathlib import Path

import pytest

from openvima.errors import ConfigError
from openvima.evaluation import EvaluationConfig, Results, evaluate
from worker_jobs import forget_ray

pytest.importorskip("torch")

NETWORK = EvaluationConfig(
    ("untrained",),
    ("visual_manipulation", "rearrange"),
    ("L1",),
    episodes=4,
    seed=7,
    batch=2,
    ablations=("no_prompt", "other_prompt_images", "scrambled_words", "shuffled_objects", "random"),
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return evaluate(replace(NETWORK, out=tmp_path_factory.mktemp("whole")))


@pytest.mark.slow
def test_two_workers_do_not_change_a_byte(whole: Path, tmp_path: Path) -> None:
    assert evaluate(replace(NETWORK, out=tmp_path, workers=2)).read_bytes() == whole.read_bytes()


@pytest.mark.slow
def test_ray_gives_the_same_bytes_and_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")
    monkeypatch.chdir(tmp_path)
    small = replace(NETWORK, tasks=NETWORK.tasks[:1], ablations=("no_prompt",))
    path = evaluate(replace(small, out=Path("processes")))
    try:
        by_ray = evaluate(replace(small, out=Path("ray"), workers=2, engine="ray"))
    finally:
        forget_ray()
    assert by_ray.read_bytes() == path.read_bytes()
    assert not ray.is_initialized()


@pytest.mark.slow
def test_batches_of_one_give_the_same_outcomes(whole: Path, tmp_path: Path) -> None:
    single = Results.read(evaluate(replace(NETWORK, out=tmp_path, batch=1)))
    assert single.rows == Results.read(whole).rows


def test_each_ablation_has_rows_of_its_own(whole: Path) -> None:
    results = Results.read(whole)
    played = list(dict.fromkeys((row.policy, row.ablation) for row in results.rows))
    assert played == [
        ("untrained", ""),
        *(("untrained", ablation) for ablation in NETWORK.ablations[:4]),
        ("random", ""),
    ]
    seeds = {tuple(outcome.seed for outcome in row.outcomes) for row in results.rows}
    assert seeds == {(7, 8, 9, 10)}
    assert results.config["ablations"] == list(NETWORK.ablations)


def test_a_policy_that_looks_at_no_ids_plays_alike_with_shuffled_objects(whole: Path) -> None:
    results = Results.read(whole)
    for task in NETWORK.tasks:
        plain, shuffled = (
            results.row("untrained", task, "L1", ablation) for ablation in ("", "shuffled_objects")
        )
        assert plain is not None and shuffled is not None
        assert shuffled.outcomes == plain.outcomes


def test_an_address_without_a_cluster_is_refused_before_anything_is_played(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    with pytest.raises(ConfigError, match="no Ray cluster answers"):
        evaluate(replace(NETWORK, out=tmp_path, engine="ray", address="127.0.0.1:1"))
