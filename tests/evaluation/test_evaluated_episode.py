"""An episode of an evaluation is played again with its exact settings."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from openvima.env import EnvConfig
from openvima.errors import DatasetError, PolicyError
from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.evaluation.evaluated_episode import evaluated_episode, find_source, success_rates
from openvima.evaluation.rollout import play
from openvima.policies.naming import CHECKPOINTS_FOLDER


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("evaluation")
    setup = EnvConfig(prompts="text", task_options="rotate.difficulty=hard")
    evaluate(
        EvaluationConfig(("oracle", "random"), ("rotate",), ("L1",), 2, seed=60, out=out, env_config=setup)
    )
    return out


@pytest.mark.parametrize("policy", ["oracle", "random"])
def test_an_episode_ends_again_as_it_did(evaluation: Path, policy: str) -> None:
    found = evaluated_episode(evaluation, policy, "rotate", "L1", 61)
    assert found.batch.env_config.task_options == "rotate.difficulty=hard"
    episode = found.sample()
    assert (episode.domain, episode.seed, episode.problem.prompt.images) == ("eval", 61, ())
    env = found.batch.env_config.make("rotate", "L1", domain="eval")
    assert found.actions is not None and len(found.actions) == found.outcome.steps
    policies = [found.recorded_policy(), *([found.load_policy()] if policy == "oracle" else [])]
    for rollout_policy in policies * 2:  # it begins anew
        (again,) = play([env], [episode], rollout_policy)
        assert again == found.outcome
    assert str(found).startswith("rotate, L1, seed 61: ")
    assert success_rates(Results.read(evaluation), policy)["rotate"]["L1"] in (0.0, 0.5, 1.0)


def test_unknown_episodes_are_named(evaluation: Path) -> None:
    with pytest.raises(DatasetError, match="Did you mean 'oracle, rotate, L1'"):
        evaluated_episode(evaluation, "oracle", "rotat", "L1", 60)
    with pytest.raises(DatasetError, match="no seed 62 there; it has 60 to 61"):
        evaluated_episode(evaluation, "oracle", "rotate", "L1", 62)


def test_a_run_is_found_by_its_weights(evaluation: Path, tmp_path: Path) -> None:
    from openvima.evaluation.sources import weights_hash

    results = Results.read(evaluation)
    run = tmp_path / "mine" / CHECKPOINTS_FOLDER / "1-cloning-000001"
    run.mkdir(parents=True)
    (run / "model.safetensors").write_bytes(b"weights")
    known = replace(results, policies={"trained": {"kind": "run", "sha256": weights_hash(tmp_path / "mine")}})
    assert find_source(tmp_path / "results", known, "trained") == str(tmp_path / "mine")
    other = replace(results, policies={"trained": {"kind": "run", "sha256": "0" * 64}})
    assert find_source(tmp_path / "results", other, "trained") is None
    bundled = replace(
        results, policies={"small": {"kind": "run", "bundled": "openvima-small", "sha256": "1"}}
    )
    assert find_source(tmp_path, bundled, "small") == "openvima-small"


def test_without_the_policy_the_recorded_actions_remain(evaluation: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(evaluation, tmp_path / "copy")
    found = evaluated_episode(copy, "random", "rotate", "L1", 60, source="")
    with pytest.raises(PolicyError, match="name its run folder"):
        found.load_policy()
    assert found.actions is not None
    (copy / "actions.arrow").unlink()
    with pytest.raises(PolicyError, match="kept no actions"):
        evaluated_episode(copy, "random", "rotate", "L1", 60).recorded_policy()


def test_no_code_that_results_name_runs_unless_it_is_trusted(
    evaluation: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.py").write_text("raise SystemExit('it ran')")
    results = Results.read(evaluation)
    for key in ("bundled", "preset"):
        for name in ("evil.py:make", "openvima-huge"):
            named = replace(results, policies={"random": {"kind": "run", key: name}})
            assert find_source(tmp_path, named, "random") is None
    nano = replace(results, policies={"random": {"kind": "untrained", "preset": "nano"}})
    assert find_source(tmp_path, nano, "random") == "untrained:nano"
    found = evaluated_episode(evaluation, "random", "rotate", "L1", 60)
    with pytest.raises(PolicyError, match=r"'evil\.py:boxes'.*--trust-code"):
        replace(found, batch=replace(found.batch, boxes="evil.py:boxes")).load_policy()


def test_episodes_at_once_share_no_policy(evaluation: Path) -> None:
    found = evaluated_episode(evaluation, "random", "rotate", "L1", 60)
    first, second = (getattr(found.load_policy(), "_policy") for _ in range(2))  # noqa: B009
    assert first is not second
