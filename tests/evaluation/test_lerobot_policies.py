"""LeRobot policies are served by another Python, here a stand-in, and scored as any other policy."""

import sys
from pathlib import Path

import pytest

from openvima.errors import ConfigError, ServerError
from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.evaluation.config import policy_sources

SOURCE = "lerobot:runs/act_rotate/checkpoints/000020/pretrained_model"
SERVER = """
import sys, threading, os
from openvima.policies import RandomPolicy
from openvima.serving import serve

assert sys.argv[1:3] == ["-m", "lerobot_env_openvima.serve"], sys.argv
threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
print("loading")
policy = RandomPolicy()
policy.modalities = ("rgb", "joints")
serve(policy, port=0, about={"asked": sys.argv[3:]}, ready=lambda url: print(url, flush=True))
"""


def fake_python(folder: Path, code: str) -> str:
    """An executable that runs some code whatever it is asked to run."""
    program = folder / "python"
    program.write_text(f"#!{sys.executable}\n{code}")
    program.chmod(0o755)
    return str(program)


def settings(tmp_path: Path, *policies: str, python: str | None) -> EvaluationConfig:
    out = tmp_path / "out"
    return EvaluationConfig(policies, ("rotate",), ("L1",), episodes=2, out=out, python=python)


def test_a_lerobot_policy_is_scored_through_the_server_of_its_python(tmp_path: Path) -> None:
    python = fake_python(tmp_path, SERVER)
    results = Results.read(evaluate(settings(tmp_path, SOURCE, "random", python=python)))
    served, local = results.rows
    assert (served.policy, local.policy) == ("act_rotate", "random")
    assert served.outcomes == local.outcomes
    metadata = results.policies["act_rotate"]["metadata"]
    asked = [SOURCE.removeprefix("lerobot:"), "--device", "cpu", "--stop-with-input"]
    assert metadata["asked"] == asked and metadata["modalities"] == ["rgb", "joints"]


def test_without_a_python_nothing_is_scored(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="evaluate --python"):
        evaluate(settings(tmp_path, SOURCE, python=None))
    with pytest.raises(ConfigError, match=r"no policy is lerobot:PATH"):
        settings(tmp_path, "random", python="python3.12")
    with pytest.raises(ConfigError, match=r"--python is '/nowhere/python', which cannot be started"):
        evaluate(settings(tmp_path, SOURCE, python="/nowhere/python"))


def test_a_server_that_does_not_start_is_named_with_its_last_line(tmp_path: Path) -> None:
    python = fake_python(tmp_path, "raise SystemExit('No module named lerobot_env_openvima')")
    with pytest.raises(
        ServerError, match=r"pretrained_model: No module named lerobot_env_openvima\. plugins"
    ):
        evaluate(settings(tmp_path, SOURCE, python=python))


def test_names_are_those_of_runs_and_repositories() -> None:
    named = policy_sources((SOURCE, "lerobot:owner/act@v1", "mine=lerobot:owner/act", "lerobot:some/folder"))
    assert [source.name for source in named] == ["act_rotate", "act-v1", "mine", "folder"]
    assert {source.kind for source in named} == {"lerobot"}
