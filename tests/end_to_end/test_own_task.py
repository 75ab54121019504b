"""A task with a word that no other prompt has, from demonstrations to a score."""

import json
import runpy
from pathlib import Path

import pytest

pytest.importorskip("torch")

from openvima.cli.main import main
from openvima.policies import load_policy
from openvima.policies.tokenizer import UNKNOWN, benchmark_vocabulary
from openvima.tasks import list_tasks, registry

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
