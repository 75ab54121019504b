"""Policies of users' code on the command line: named, scored, recorded, and what goes wrong with them."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from openvima import user_code
from openvima.cli.main import main
from openvima.env import EnvConfig
from openvima.errors import ConfigError, PolicyError, ServerError
from openvima.evaluation import EvaluationConfig, Results, evaluate, score
from openvima.evaluation.verification import verify_results
from openvima.policies import RandomPolicy, load_policy
from openvima.policies.loading import parameters_hash

CODE = """
from openvima.policies import RandomPolicy

class Mine(RandomPolicy):
    weights_hash = "first weights"

    def act(self, observations):
        return self.edited(super().act(observations))

    def edited(self, actions):
        return actions

def make():
    return Mine(seed=3)
"""
WORDS = ["--tasks", "rotate", "--levels", "L1", "--no-report", "--episodes"]
CELLS = {"tasks": ("rotate",), "levels": ("L1",), "episodes": 2}


@pytest.fixture(autouse=True)
def _restored(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(user_code, "_loaded", {})


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my policies.py").write_text(CODE)
    return Path("my policies.py")


def edited(body: str) -> str:
    return CODE.replace("        return actions", f"        {body}")


def test_a_function_of_a_file_is_scored_from_the_command_line(file, capsys):
    words = [*WORDS, "2", "--out", "results"]
    assert main(["evaluate", "--policy", "my policies.py:make,other=./my policies.py:Mine", *words]) == 0
    results = Results.read(Path("results"))
    record = results.policies["my-policies"]
    assert (record["kind"], record["source"]) == ("code", "my policies.py:make")
    assert record["weights_sha256"] == "first weights"
    assert len(record["sha256"]) == 64
    assert results.policies["other"]["source"] == "my policies.py:Mine"
    assert str(file.absolute().parent) not in Path("results", "results.json").read_text()
    same = score({"mine": RandomPolicy(seed=3)}, **CELLS)
    assert results.row("my-policies", "rotate", "L1").outcomes == same.rows[0].outcomes
    file.write_text(CODE + "\n")
    assert main(["evaluate", "--policy", "my policies.py:make", *words]) == 2
    assert "holds another evaluation" in capsys.readouterr().err


def test_controls_read_environments_and_say_so(tmp_path):
    folder = Path(__file__).parents[2] / "benchmarks"
    named = (f"reader={folder}/reader.py:reader", f"similar={folder}/controls.py:similar")
    tasks, levels = ("visual_manipulation", "put_then_restore", "refer_by_number"), ("L5", "L6", "L7")
    asked = EvaluationConfig(
        named, tasks, levels, episodes=1, out=tmp_path, env_config=EnvConfig(prompts="text")
    )
    results = Results.read(evaluate(asked))
    assert {what["reads"] for what in results.policies.values()} == {"environment"}
    assert [row.successes for row in results.rows if row.policy == "reader"] == [1, 1, 1]
    assert verify_results(tmp_path).is_verified
    with pytest.raises(PolicyError, match="reader reads environments, which 'no_prompt' does not change"):
        evaluate(replace(asked, out=tmp_path / "ablated", ablations=("no_prompt",)))


def test_invalid_actions_are_counted_and_the_first_is_shown(file, capsys):
    file.write_text(
        edited("return [a and {**a, 'pose0_position': a['pose0_position'] + 9} for a in actions]")
    )
    policies = ["--policy", "bad=my policies.py:make,random", "--ablations", "no_prompt"]
    assert main(["evaluate", *policies, *WORDS, "2"]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "4 of 4 episodes of bad ended by an invalid action; first in rotate, L1, seed 0: pose0_pos" in said
    assert "episodes of random" not in said
    (found,) = json.loads(Path("evaluation/results.json").read_text())["invalid_actions"]
    assert (found["policy"], found["invalid"], found["episodes"]) == ("bad", 4, 4)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            "return 1 / 0",
            r"mine raised ZeroDivisionError: .* \(my policies.py, line 11\), in rotate, L1, seeds 0, 1",
        ),
        (
            "return actions[0]",
            "mine gave a dict for 2 observations; act must return a list",
        ),
        ("return actions[:1]", "mine gave 1 actions for 2 observations"),
        (
            "return [actions[0], None]",
            "mine gave no action for rotate, L1, seed 1, whose episode is not over",
        ),
    ],
)
def test_what_a_policy_does_wrong_is_named_with_task_and_seeds(body, message, file):
    file.write_text(edited(body))
    with pytest.raises(PolicyError, match=message):
        evaluate(EvaluationConfig((f"mine={file}:make",), **CELLS))


def test_exceptions_in_some_episodes_are_counted_kept_and_verified(file, capsys):
    body = "self.n = getattr(self, 'n', 0) + 1; return actions if len(actions) == 1 and self.n < 4 else 1 / 0"
    file.write_text(edited(body))
    assert main(["evaluate", "--policy", f"bad={file}:make", "--workers", "1", *WORDS, "3"]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "episodes of bad ended by an error of the policy; first in rotate, L1, seed" in said
    assert "bad raised ZeroDivisionError" in said
    (found,) = json.loads(Path("evaluation/results.json").read_text())["policy_errors"]
    assert (found["policy"], found["episodes"]) == ("bad", 3)
    assert found["raised"] > 0
    assert verify_results(Path("evaluation")).is_verified


def test_exhausted_memory_is_no_error_of_the_policy(file, capsys):
    file.write_text(edited("raise RuntimeError('cannot allocate memory')"))
    assert main(["evaluate", "--policy", f"{file}:make", *WORDS, "1"]) == 1
    assert "out of memory; lower" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return None", "make returned a NoneType without reset and act; a policy has the methods reset"),
        ("return Mine", r"make returned the class Mine, not an object of it; return Mine\(\)"),
        ("Mine.act = 3; return Mine()", "returned a Mine without act;"),
        ("Mine.weights_hash = 3; return Mine()", "weights_hash of Mine is a int; give a text"),
    ],
)
def test_what_is_no_policy_is_named_before_anything_is_played(body, message, file):
    file.write_text(CODE.replace("return Mine(seed=3)", body))
    with pytest.raises(PolicyError, match=message):
        evaluate(EvaluationConfig((f"{file}:make",), **CELLS))
    assert not Path("evaluation", "parts").exists()


def test_code_extracts_objects_itself(file):
    with pytest.raises(ConfigError, match="extracts objects itself"):
        load_policy(f"{file}:make", extractor=object())


def test_weights_of_torch_modules_are_hashed_by_value():
    torch = pytest.importorskip("torch")

    class Held:
        def __init__(self, value):
            self.network = torch.nn.Linear(2, 1, dtype=torch.bfloat16)
            torch.nn.init.constant_(self.network.weight, value)
            torch.nn.init.zeros_(self.network.bias)
            self.scale = np.ones(2)

    assert parameters_hash(Held(1)) == parameters_hash(Held(1)) != parameters_hash(Held(2))
    assert parameters_hash(Held(1).network) is not None
    assert parameters_hash(RandomPolicy()) is None


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
    with pytest.raises(ConfigError, match=r"--python is '/nowhere/python', which cannot be started"):
        evaluate(settings(tmp_path, SOURCE, python="/nowhere/python"))


def test_a_server_that_does_not_start_is_named_with_its_last_line(tmp_path: Path) -> None:
    python = fake_python(tmp_path, "raise SystemExit('No module named lerobot_env_openvima')")
    with pytest.raises(
        ServerError, match=r"pretrained_model: No module named lerobot_env_openvima\. plugins"
    ):
        evaluate(settings(tmp_path, SOURCE, python=python))
