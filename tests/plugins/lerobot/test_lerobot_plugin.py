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

from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.evaluation.actions import read_actions

HERE = Path(__file__).parent
PYTHON = os.environ.get("OPENVIMA_LEROBOT_PYTHON", "")
FIRST, EPISODES = 1000, 6
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
    paths = [str(found.parent), str(HERE), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # as the policy server computes


def run(*arguments: str) -> None:
    command = [PYTHON, str(HERE / "run_in_lerobot.py"), *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-3000:]


def check(policy: Path, tmp_path: Path, *, batch: int) -> int:
    """Score a policy both ways, and return its number of successes."""
    actions, out = tmp_path / "actions.json", tmp_path / "lerobot"
    options = [f"--policy.path={policy}", "--policy.device=cpu", "--env.type=openvima", "--env.task=rotate"]
    options += ["--env.level=L1", f"--eval.n_episodes={EPISODES}", f"--eval.batch_size={batch}"]
    run(
        "eval",
        str(actions),
        *options,
        f"--seed={FIRST}",
        f"--output_dir={out}",
        "--eval.use_async_envs=false",
    )
    theirs = json.loads((out / "eval_info.json").read_text())["per_task"][0]["metrics"]["successes"]

    source = f"policy=lerobot:{policy}"
    config = EvaluationConfig(
        (source,), ("rotate",), ("L1",), EPISODES, FIRST, out=tmp_path / "ours", python=PYTHON
    )
    results = Results.read(evaluate(config))
    (row,) = results.rows
    assert [outcome.success for outcome in row.outcomes] == theirs
    found = json.loads(actions.read_text())
    for outcome, ours in zip(row.outcomes, read_actions(config.out, [row])[0][0], strict=True):
        np.testing.assert_allclose(found[str(outcome.seed)][: len(ours)], ours, atol=1e-5)
    assert (out / "videos" / "rotate_0" / "eval_episode_0.mp4").stat().st_size > 0
    assert results.policies["policy"]["metadata"]["modalities"] == ["rgb", "joints"]
    return row.successes


def test_a_scripted_policy_that_solves_episodes_is_scored_alike(tmp_path: Path) -> None:
    folder = tmp_path / "scripted"
    run("save", str(folder))
    assert 0 < check(folder, tmp_path, batch=2) < EPISODES + 1


@pytest.mark.skipif("OPENVIMA_LEROBOT_POLICY" not in os.environ, reason="OPENVIMA_LEROBOT_POLICY is not set")
def test_a_trained_policy_is_scored_alike(tmp_path: Path) -> None:
    check(Path(os.environ["OPENVIMA_LEROBOT_POLICY"]).resolve(), tmp_path, batch=1)
