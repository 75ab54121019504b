"""Whole evaluations: the same bytes whoever plays the batches, resumed where they stopped."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from openvima.env import EnvConfig
from openvima.errors import AssetError, ConfigError, FolderLockedError
from openvima.evaluation import EvaluationConfig, Results, evaluate, runner
from openvima.evaluation.config import plan
from worker_jobs import forget_ray, holding

ORACLE = EvaluationConfig(
    ("oracle",), ("rotate", "sweep_without_exceeding"), ("L2",), episodes=3, seed=40, batch=2
)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The oracle's results, played by one process."""
    return evaluate(replace(ORACLE, out=tmp_path_factory.mktemp("first")))


def test_the_oracle_solves_its_episodes(first):
    results = Results.read(first)
    assert [(row.task, row.successes, row.episodes) for row in results.rows] == [
        ("rotate", 3, 3),
        ("sweep_without_exceeding", 3, 3),
    ]
    assert [outcome.seed for outcome in results.rows[0].outcomes] == [40, 41, 42]
    assert results.policies == {"oracle": {"kind": "oracle"}}
    assert "torch" not in results.versions
    assert "seconds" not in first.read_text()
    log = json.loads((first.parent / "evaluation_log.json").read_text())
    assert log["seconds"] > 0 and log["engine"] == "processes"


def test_jobs_that_share_a_folder_play_their_own_batches_and_give_the_same_bytes(
    first, tmp_path, monkeypatch
):
    played, play_batch = [], runner.play_batch
    monkeypatch.setattr(
        runner, "play_batch", lambda batch, count: played.append(batch) or play_batch(batch, count)
    )
    config = replace(ORACLE, out=tmp_path)
    assert len(plan(config)) == 4
    assert not runner.evaluate_range(config, (2, 9))
    assert sorted(batch.episode for batch in played) == sorted(batch.episode for batch in plan(config)[2:])
    assert not (tmp_path / "results.json").exists()
    with (
        holding(tmp_path, 1, 2),
        pytest.raises(FolderLockedError, match="is being written to by"),
    ):
        runner.evaluate_range(config, (0, 2))
    assert runner.evaluate_range(config, (0, 2))
    assert (tmp_path / "results.json").read_bytes() == first.read_bytes()
    assert not runner.evaluate_range(config, (1, 3))  # all is there
    assert len(played) == 4
    with pytest.raises(ConfigError, match="4:5, but shards are numbered from 0 to 3"):
        runner.evaluate_range(config, (4, 5))
    with pytest.raises(ConfigError, match="force and shard_range exclude"):
        runner.evaluate_range(replace(config, force=True), (0, 1))
    with pytest.raises(ConfigError, match=r"holds another evaluation: seed is .* there and 41 here"):
        runner.evaluate_range(replace(config, seed=41), (0, 1))


def test_an_interrupted_evaluation_goes_on_where_it_stopped(first, tmp_path, monkeypatch):
    played = []

    def play_two(batch, count):
        if len(played) == 2:
            raise KeyboardInterrupt
        played.append(batch)
        return play_batch(batch, count)

    play_batch = runner.play_batch
    config = replace(ORACLE, out=tmp_path)
    monkeypatch.setattr(runner, "play_batch", play_two)
    with pytest.raises(KeyboardInterrupt):
        evaluate(config)
    assert not (tmp_path / "results.json").exists()
    rest = []
    monkeypatch.setattr(
        runner, "play_batch", lambda batch, count: rest.append(batch) or play_batch(batch, count)
    )
    assert evaluate(config).read_bytes() == first.read_bytes()
    assert len(rest) == 2
    assert not set(rest) & set(played)
    assert not (tmp_path / "parts").exists()


def test_parts_of_other_assets_are_not_kept(tmp_path, monkeypatch):
    def stop(done, total, note):
        if done == 3:
            raise KeyboardInterrupt

    monkeypatch.setenv("OPENVIMA_LOADED_ASSETS", "")  # restores it afterwards
    file = tmp_path / "assets_of_a_test.py"
    config = replace(ORACLE, out=tmp_path / "out", env_config=EnvConfig(f"{file}:make"))
    for content in ("def make(): ...\n", "def make(): pass\n"):
        file.write_text(content)
        with pytest.raises(KeyboardInterrupt):
            evaluate(config, stop)
    assert len(list((tmp_path / "out/parts").iterdir())) == 4


def test_damaged_parts_are_played_again(first, tmp_path):
    def stop(done, total, note):
        if done == 5:
            raise KeyboardInterrupt

    config = replace(ORACLE, out=tmp_path)
    with pytest.raises(KeyboardInterrupt):
        evaluate(config, stop)
    parts = list((tmp_path / "parts").iterdir())
    for part, content in zip(parts, (parts[0].read_text()[:-20], "[]", "{}"), strict=True):
        part.write_text(content)
    assert evaluate(config).read_bytes() == first.read_bytes()


def test_finished_results_are_kept_and_others_not_overwritten(first, monkeypatch):
    monkeypatch.setattr(runner, "play_batch", lambda batch, count: pytest.fail("nothing should be played"))
    config = replace(ORACLE, out=first.parent)
    before = first.read_bytes()
    assert evaluate(config) == first
    with pytest.raises(ConfigError, match="--force"):
        evaluate(replace(config, seed=41))
    assert first.read_bytes() == before


def test_progress_counts_episodes_up_to_all_of_them(tmp_path):
    calls = []
    config = EvaluationConfig(("oracle",), ("rotate",), ("L1",), episodes=3, batch=2, out=tmp_path)
    evaluate(config, lambda *call: calls.append(call))
    assert calls == [(0, 3, ""), (2, 3, "oracle rotate L1"), (3, 3, "oracle rotate L1")]


def test_an_unknown_asset_pack_is_named_before_anything_is_written(tmp_path):
    with pytest.raises(AssetError, match="nosuch"):
        evaluate(replace(ORACLE, out=tmp_path / "out", env_config=EnvConfig(assets="nosuch")))
    assert not (tmp_path / "out").exists()


def test_a_second_evaluation_in_a_folder_is_refused_at_once(tmp_path):
    with (
        holding(tmp_path) as process,
        pytest.raises(FolderLockedError, match=rf"by process {process.pid}\b"),
    ):
        evaluate(replace(ORACLE, out=tmp_path))


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
    pytest.importorskip("torch")
    return evaluate(replace(NETWORK, out=tmp_path_factory.mktemp("whole")))


@pytest.mark.slow
def test_two_workers_do_not_change_a_byte(whole: Path, tmp_path: Path) -> None:
    assert evaluate(replace(NETWORK, out=tmp_path, workers=2)).read_bytes() == whole.read_bytes()


@pytest.mark.slow
def test_ray_gives_the_same_bytes_and_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")
    monkeypatch.chdir(tmp_path)
    small = replace(NETWORK, policies=("random",), tasks=NETWORK.tasks[:1], ablations=())
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


def test_each_ablation_has_rows_of_its_own_alike_where_a_policy_does_not_look(whole: Path) -> None:
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
    for task in NETWORK.tasks:
        plain, shuffled = (results.row("untrained", task, "L1", name) for name in ("", "shuffled_objects"))
        assert plain is not None and shuffled is not None and shuffled.outcomes == plain.outcomes
