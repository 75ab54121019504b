"""Evaluated episodes, and their recording."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from openvima.env import EnvConfig
from openvima.env.tabletop import TabletopEnv
from openvima.errors import PolicyError
from openvima.evaluation import EvaluationConfig, Results, evaluate, save_episode_image
from openvima.evaluation.evaluated_episode import evaluated_episode, find_source
from openvima.evaluation.recording import record_episode
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import OracleRolloutPolicy
from openvima.policies.naming import CHECKPOINTS_FOLDER
from openvima.video.recorder import SceneRenderer
from small_data_sets import frames_of


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


@pytest.fixture(scope="module")
def env():
    return TabletopEnv("rotate", level="L1", domain="eval", realtime=True)


def test_a_video_contains_the_prompt_the_start_the_arm_and_the_end(env, tmp_path):
    outcome = record_episode(env, OracleRolloutPolicy(), 0, tmp_path / "video.mp4", title="rotate")
    frames = frames_of(tmp_path / "video.mp4")
    assert outcome.success
    assert 3 < len(frames) / 30 < 15
    rows, columns, _ = frames[0].shape
    assert columns == 768 and rows > 384 + 32
    top = rows - 32 - 384  # prompt above, one line below
    assert all(
        np.abs(frame[: top - 2].astype(int) - frames[0][: top - 2]).mean() < 2 for frame in frames[::10]
    )
    env.reset(seed=0)
    start = SceneRenderer(env).draw(env.scene).astype(int)
    assert np.abs(frames[0][top : top + 384] - start).mean() < 4
    assert (
        np.abs(frames[-1][top : top + 384] - start).mean() > np.abs(frames[0][top : top + 384] - start).mean()
    )


def test_the_image_of_an_episode_has_prompt_start_and_end(tmp_path):
    env = TabletopEnv("visual_manipulation")
    path = tmp_path / "new" / "look.png"
    outcome = save_episode_image(env, path, seed=0)
    image = np.asarray(Image.open(path)).astype(int)
    assert outcome.success
    width, middle = image.shape[1], image.shape[1] // 2
    start, end = image[-256:-12, 12 : middle - 6], image[-256:-12, middle + 6 : width - 12]
    assert start.shape == end.shape
    assert 0.5 < np.abs(start - end).mean() < 60
