"""One policy scored by lerobot-eval and by our evaluation: the same actions and successes on the same seeds.

Runs where OPENVIMA_LEROBOT_PYTHON names the Python of an environment with LeRobot and the plugin, which
plugins/lerobot/make_environment.sh makes. OPENVIMA_LEROBOT_POLICY may name a trained policy besides.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from openvima.env.config import EnvConfig
from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.evaluation.actions import read_actions
from openvima.evaluation.results import Row

HERE = Path(__file__).parent
PYTHON = os.environ.get("OPENVIMA_LEROBOT_PYTHON", "")
FIRST, EPISODES = 1000, 6
PUBLISHED = EnvConfig()
LOW_LEVEL = EnvConfig(prompts="text", control="end_effector")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not PYTHON, reason="OPENVIMA_LEROBOT_PYTHON names no Python of a LeRobot environment"),
]


@pytest.fixture(autouse=True)
def scripted_plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let LeRobot discover the scripted policy as an installed distribution."""
    found = tmp_path / "site" / "lerobot_policy_scripted-0.dist-info"
    found.mkdir(parents=True)
    found.joinpath("METADATA").write_text(
        "Metadata-Version: 2.1\nName: lerobot_policy_scripted\nVersion: 0\n"
    )
    paths = [
        str(found.parent),
        str(HERE),
        str(HERE.parents[2] / "examples"),
        os.environ.get("PYTHONPATH", ""),
    ]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # as the policy server computes


def run(*arguments: str) -> None:
    command = [PYTHON, str(HERE / "run_in_lerobot.py"), *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-3000:]


def check(policy: Path, tmp_path: Path, *, batch: int, env_config: EnvConfig = PUBLISHED) -> int:
    """Score a policy both ways, and return its number of successes."""
    actions, out = tmp_path / "actions.json", tmp_path / "lerobot"
    options = [f"--policy.path={policy}", "--policy.device=cpu", "--env.type=openvima", "--env.task=rotate"]
    options += ["--env.level=L1", f"--eval.n_episodes={EPISODES}", f"--eval.batch_size={batch}"]
    options += [f"--env.control={env_config.control}", f"--env.prompts={env_config.prompts}"]
    run(
        "eval",
        str(actions),
        *options,
        f"--seed={FIRST}",
        f"--output_dir={out}",
        "--eval.use_async_envs=false",
    )
    theirs = json.loads((out / "eval_info.json").read_text())["per_task"][0]["metrics"]["successes"]

    config, row = score_here(policy, tmp_path / "ours", EPISODES, env_config)
    assert [outcome.success for outcome in row.outcomes] == theirs
    found = json.loads(actions.read_text())
    for outcome, ours in zip(row.outcomes, read_actions(config.out, [row])[0][0], strict=True):
        np.testing.assert_allclose(found[str(outcome.seed)][: len(ours)], ours, atol=1e-5)
    assert (out / "videos" / "rotate_0" / "eval_episode_0.mp4").stat().st_size > 0
    return row.successes


def score_here(policy: Path, out: Path, episodes: int, env_config: EnvConfig) -> tuple[EvaluationConfig, Row]:
    """Score a policy by our evaluation; it gets no segmentation."""
    config = EvaluationConfig(
        (f"policy=lerobot:{policy}",),
        ("rotate",),
        ("L1",),
        episodes,
        FIRST,
        out=out,
        python=PYTHON,
        env_config=env_config,
    )
    results = Results.read(evaluate(config))
    metadata = results.policies["policy"]["metadata"]
    assert (metadata["modalities"], metadata["control"]) == (["rgb", "joints"], env_config.control)
    assert not results.invalid_actions()
    return config, results.rows[0]


def test_a_scripted_policy_that_solves_episodes_is_scored_alike(tmp_path: Path) -> None:
    folder = tmp_path / "scripted"
    run("save", str(folder), "primitives")
    assert 0 < check(folder, tmp_path, batch=2) < EPISODES + 1


def test_a_rule_for_language_solves_the_same_episodes_by_commands_of_the_tool(tmp_path: Path) -> None:
    folder = tmp_path / "scripted"
    run("save", str(folder), "end_effector")
    assert check(folder, tmp_path, batch=1, env_config=LOW_LEVEL) > EPISODES // 2


@pytest.mark.parametrize("env_config", [PUBLISHED, LOW_LEVEL], ids=lambda each: each.control)
def test_a_vision_language_action_model_acts_through_the_bridge(
    tmp_path: Path, env_config: EnvConfig
) -> None:
    folder = tmp_path / "smolvla"
    run("smolvla", str(folder), env_config.control)
    _, row = score_here(folder, tmp_path / "out", 1, env_config)
    assert row.outcomes[0].steps > 0  # its weights are random


@pytest.mark.skipif("OPENVIMA_LEROBOT_POLICY" not in os.environ, reason="OPENVIMA_LEROBOT_POLICY is not set")
def test_a_trained_policy_is_scored_alike(tmp_path: Path) -> None:
    check(Path(os.environ["OPENVIMA_LEROBOT_POLICY"]).resolve(), tmp_path, batch=1)
