"""From nothing to a report on the command line, in small, and for users without a name and a home."""

import json
import os
import runpy
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")

from openvima.cli.main import main
from openvima.policies import load_policy, presets
from openvima.policies.nn.image_encoders import ConvConfig
from openvima.policies.tokenizer import UNKNOWN, benchmark_vocabulary
from openvima.tasks import list_tasks, registry

TASKS = "rotate,sweep_without_exceeding"


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of a preset of a narrow network."""

    def sizes():
        nano = presets.preset("nano")
        return replace(nano, images=replace(nano.images, crop=ConvConfig(width=4, output_width=16)))

    monkeypatch.setitem(presets.PRESETS, "tiny", sizes)
    return "tiny"


def run(*words: object) -> None:
    assert main([str(word) for word in words]) == 0


@pytest.mark.filterwarnings("ignore::openvima.errors.UnknownWordWarning")  # of words beyond these few
def test_demonstrations_training_scores_and_report(tiny: str, tmp_path: Path, capsys) -> None:
    folder = tmp_path / "my runs"  # a space in all names
    demos, trained, results = folder / "demos", folder / "trained", folder / "results"
    run("generate", "--tasks", TASKS, "--episodes", 3, "--out", demos)
    options = (
        "--loader.batch-size 4 --schedule.steps 3 --recipe nano --pretraining.steps 0 --runtime.threads 1"
    )
    train = ["train", "--data", demos, "--preset", tiny, "--out", trained, *options.split()]
    train += ["--schedule.checkpoint-every", 2]
    run(*train)
    assert f"--policy '{trained}' --out" in capsys.readouterr().err
    policies = f"mine={trained},oracle,random"
    evaluate = ["evaluate", "--policy", policies, "--tasks", TASKS, "--levels", "L1", "--episodes", 2]
    run(*evaluate, "--videos", 0, "--out", results)

    rows = json.loads((results / "results.json").read_text(encoding="utf-8"))["rows"]
    assert {(row["policy"], row["task"]) for row in rows} == {
        (policy, task) for policy in ("mine", "oracle", "random") for task in TASKS.split(",")
    }
    assert all(row["episodes"] == 2 and 0 <= row["successes"] <= 2 for row in rows)
    page = (results / "report.html").read_text(encoding="utf-8")
    assert all(name in page for name in ("mine", "oracle", "random"))

    weights = (trained / "checkpoints" / "2-cloning-000003" / "model.safetensors").read_bytes()
    capsys.readouterr()
    run(*train)  # again: nothing is left to do
    assert (trained / "checkpoints" / "2-cloning-000003" / "model.safetensors").read_bytes() == weights
    assert capsys.readouterr().out.strip().endswith("my runs/trained")


TASK_FILE = Path(__file__).parents[2] / "examples" / "custom_task.py"


@pytest.mark.slow
def test_a_task_with_an_unseen_word_is_generated_trained_and_scored(tmp_path: Path, monkeypatch) -> None:
    list_tasks()  # loads them, so that what the file registers goes when the test ends
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    runpy.run_path(str(TASK_FILE))
    monkeypatch.chdir(tmp_path)
    generate = "generate --tasks put_between --episodes 40 --out demos"
    train = (
        "train --data demos --preset nano --recipe nano --out run --schedule.steps 30 --loader.batch-size 4 "
        "--schedule.checkpoint-every 10 --pretraining.steps 0 --loader.validation-episodes 4"
    )
    evaluate = (
        "evaluate --policy run --tasks put_between --levels L1,L3 --episodes 2 --no-report --out scores"
    )
    for command in (generate, train, evaluate):
        assert main(command.split()) == 0

    words = set(load_policy("run").processor.tokenizer.vocabulary.words)  # type: ignore[attr-defined]
    assert words == {UNKNOWN, "put", "the", "between", "and", "."}
    assert "between" not in benchmark_vocabulary().words
    metrics = [json.loads(line) for line in Path("run/metrics.jsonl").read_text("utf-8").splitlines()]
    first, *_, last = [line["loss"] for line in metrics if "loss" in line]
    assert last < 0.95 * first
    rows = json.loads(Path("scores/results.json").read_text("utf-8"))["rows"]
    assert [row["episodes"] for row in rows] == [2, 2]


NAMELESS = 12345  # a user id that no system gives
PROGRAM = """
import os, pwd, sys

def unknown(uid):
    raise KeyError(f"getpwuid(): uid not found: {uid}")

pwd.getpwuid = unknown
from openvima.cli.main import main

for words in (
    "assets info",
    "evaluate --policy oracle --tasks rotate --levels L1 --episodes 1 --workers 1 --no-report --out scores",
    "generate --tasks rotate --episodes 8 --workers 1 --out demos",
    "train --data demos --preset nano --schedule.steps 2 --schedule.warmup-steps 1 --pretraining.steps 0"
    " --loader.batch-size 2 --loader.validation-episodes 2 --runtime.device cpu --out run",
):
    if status := main(words.split()):
        sys.exit(f"{words}: {status}")
"""


def may_be_read_by_all(path: Path) -> bool:
    return all(folder.stat().st_mode & 0o005 == 0o005 for folder in (path, *path.parents))


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that every user may enter, unlike those of pytest."""
    made = Path(tempfile.mkdtemp())
    made.chmod(0o777)
    yield made
    shutil.rmtree(made)


@pytest.mark.slow
@pytest.mark.parametrize("user", [None, NAMELESS])
def test_a_user_without_name_and_home_gets_from_assets_to_a_training(user: int | None, folder: Path) -> None:
    torch, python = Path(sys.modules["torch"].__file__ or "").parent, Path(sys.executable).resolve().parent
    code = torch, python, Path(__file__).parents[2] / "src"
    if user is not None and not (os.getuid() == 0 and all(map(may_be_read_by_all, code))):
        pytest.skip("takes root, and an environment that others may read")
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("HOME", "XDG", "OPENVIMA"))
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=folder,
        env={**kept, "TMPDIR": str(folder)},
        user=user,
        group=user,
        extra_groups=None if user is None else [],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert {"scores", "demos", "run"} <= {path.name for path in folder.iterdir()}
    assert not (folder / "~").exists()
