"""Every example runs as it stands."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from bounds import ForcedPolicy, nearest, separated
from openvima.data import Dataset, GenerateConfig, generate
from openvima.env import TabletopEnv
from openvima.evaluation import EvaluationConfig, Results, evaluate, score
from openvima.evaluation.rollout import play
from openvima.evaluation.sources import PolicySource
from openvima.policies import RandomPolicy, load_policy
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
from openvima.scene import Placement, Pose
from openvima.tasks import list_tasks, registry
from small_networks import narrow_small
from user_shapes import restored_assets

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))
# Run in tests of their own: one goes on until it is stopped, others have names, want to be trained, or need
# another simulator.
APART = (
    *("policy_server", "custom_learner", "own_network", "own_training_loop", "score_my_policy"),
    *("score_in_original_benchmark", "dagger", "soft_actor_critic", "vla_policy", "language_rule"),
)


@pytest.mark.parametrize(
    "example", [path for path in EXAMPLES if path.stem not in APART], ids=lambda path: path.stem
)
@pytest.mark.slow
def test_the_example_runs_and_is_short(
    example: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    list_tasks()  # loads them, so that what an example registers goes when the test ends
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    assert len(example.read_text(encoding="utf-8").splitlines()) <= 70
    with restored_assets():
        runpy.run_path(str(example), run_name="__main__")
    assert "olved" in capsys.readouterr().out


def test_the_policy_of_ones_own_reads_the_prompt_and_inherits_from_nothing() -> None:
    policy = load_policy(f"{EXAMPLES[0].with_name('score_my_policy.py')}:make")
    assert type(policy).__mro__ == (type(policy), object)
    cells = {"tasks": ("visual_manipulation",), "levels": ("L2",), "episodes": 6}
    mine, random = score({"mine": policy, "random": RandomPolicy()}, **cells).level_means()
    assert mine.mean >= 0.8 and random.mean <= 0.2


@pytest.mark.slow
def test_the_network_of_ones_own_is_trained_and_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    for name in ("own_network.py", "own_training_loop.py"):
        text = EXAMPLES[0].with_name(name).read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 60
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    generate(GenerateConfig(out=Path("demos"), tasks=("visual_manipulation",), episodes=4))
    subprocess.run([sys.executable, "own_training_loop.py", "demos", "2"], check=True)
    config = EvaluationConfig(("own_network.py:make",), ("visual_manipulation",), ("L1",), episodes=2)
    results = Results.read(evaluate(config))
    assert results.rows[0].episodes == 2 and not results.invalid_actions()
    trained = results.policies["own_network"]
    Path("own_network.pt").unlink()
    assert PolicySource("own", "own_network.py:make").record()["weights_sha256"] != trained["weights_sha256"]


@pytest.mark.slow
def test_dagger_and_behaviour_cloning_are_compared_at_equal_labels() -> None:
    pytest.importorskip("torch")
    words = ["--labels", "90", "--rounds", "3", "--steps", "3", "--episodes", "2"]
    script = str(EXAMPLES[0].with_name("dagger.py"))
    done = subprocess.run([sys.executable, script, *words], capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert [line.split(":")[0] for line in lines] == ["behaviour cloning, 90 labels", "DAgger, 90 labels"]
    assert all(" of 2, " in line for line in lines)


@pytest.mark.slow
def test_soft_actor_critic_is_compared_with_random_actions() -> None:
    pytest.importorskip("stable_baselines3")
    script = str(EXAMPLES[0].with_name("soft_actor_critic.py"))
    words = ["--steps", "40", "--episodes", "2"]
    done = subprocess.run([sys.executable, script, *words], capture_output=True, text=True, check=True)
    *_, random, learned = done.stdout.splitlines()
    assert random.startswith("random actions: solved ") and learned.startswith("soft actor-critic: solved ")


@pytest.mark.slow
def test_a_task_file_is_all_that_demonstrations_and_scores_need(tmp_path: Path) -> None:
    environment = {**os.environ, registry.TASK_FILES_VARIABLE: str(EXAMPLES[0].with_name("custom_task.py"))}

    def openvima(*words: str) -> str:
        command = [sys.executable, "-m", "openvima", *words]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "put_between" in openvima("tasks")
    openvima("generate", "--tasks=put_between", "--episodes=6", "--workers=2", f"--out={tmp_path / 'd'}")
    assert len(Dataset(tmp_path / "d")) == 6
    scores = openvima(
        *("evaluate", "--policy", "oracle", "--tasks", "put_between", "--levels", "L1,L2,L3"),
        *("--episodes", "20", "--no-report", "--json", "--out", str(tmp_path / "e")),
    )
    assert [row["successes"] for row in json.loads(scores)] == [20, 20, 20]


def test_a_task_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "openvima", "tasks"],
        env={**os.environ, registry.TASK_FILES_VARIABLE: str(tmp_path / "none.py")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2 and "none.py" in done.stderr


def placed(object_id: int, shape: str, texture: str) -> Placement:
    return Placement(object_id, shape, texture, (0.1, 0.1, 0.1), Pose.planar(0.5, 0.0), fixed=shape == "bowl")


OBJECTS = (
    placed(1, "bowl", "red"),
    placed(2, "heart", "red"),
    placed(3, "heart", "blue"),
    placed(4, "star", "red"),
)


def test_the_nearest_object_is_right_if_it_is_what_the_image_shows() -> None:
    shown = [
        placed(0, "heart", "blue"),
        placed(0, "heart", "gray"),
        placed(0, "star", "red"),
        placed(0, "ring", "red"),
    ]
    similarity = torch.tensor([[0, 0, 1, 0], [0, 1, 0, 0], [1, 0, 0, 0.5], [1, 0, 0, 0]])
    answers = nearest(shown, OBJECTS, similarity)
    assert [is_right for is_right, *_ in answers] == [True, True, False]  # no ring lies on the table
    assert answers[-1][1:] == ("red star", "red bowl")


@pytest.mark.parametrize(
    ("similarity", "is_separated"), [((1, 0.8, 0.7, 0.9), True), ((1, 0.6, 0.7, 0.9), False)]
)
def test_objects_are_separated_if_the_least_right_one_is_above_all_wrong_ones(
    similarity: tuple[float, ...], is_separated: bool
) -> None:
    answers = separated(OBJECTS[0], {2, 4}, OBJECTS, torch.tensor(similarity), "texture")
    assert answers == [(is_separated, "red: red", "blue")]


@pytest.mark.parametrize(("force", "solved"), [("picks+places", True), ("free", False)])
def test_a_network_that_knows_nothing_solves_what_it_is_forced_to(force: str, solved: bool) -> None:
    policy = NetworkPolicy(build_network(narrow_small(), seed=0), dtype=torch.float32)
    envs = [TabletopEnv("visual_manipulation", level="L1", domain="eval") for _ in range(2)]
    outcomes = play(envs, [0, 1], ForcedPolicy(policy, force, torch.Generator()))
    assert [outcome.success for outcome in outcomes] == [solved, solved]


def test_guesses_follow_from_their_generator_alone_and_are_sometimes_right() -> None:
    def solved(network_seed: int) -> list[bool]:
        policy = NetworkPolicy(build_network(narrow_small(), seed=network_seed), dtype=torch.float32)
        envs = [TabletopEnv("visual_manipulation", level="L1", domain="eval") for _ in range(8)]
        generator = torch.Generator().manual_seed(0)
        return [each.success for each in play(envs, range(8), ForcedPolicy(policy, "guess", generator))]

    assert solved(0) == solved(1)
    assert set(solved(0)) == {True, False}
