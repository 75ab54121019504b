"""Custom learners in the training loop; rollouts, TensorBoard, compilation."""

import json
import shutil
import sys
from pathlib import Path

import pytest
import torch

from openvima.cli.main import main
from openvima.errors import ConfigError
from openvima.evaluation import Results
from openvima.evaluation.recording import OnlineEval
from openvima.training import TrainingConfig, train
from openvima.training.learner import Learner, make_learner
from small_networks import metrics_of

EXAMPLE = Path(__file__).parents[2] / "examples" / "custom_learner.py"


@pytest.fixture
def example(monkeypatch) -> str:
    """The preset of the example."""
    monkeypatch.syspath_prepend(str(EXAMPLE.parent))
    yield "custom_learner:make"
    sys.modules.pop("custom_learner", None)


def test_the_example_of_a_learner_is_trained_resumed_and_scored(data, tmp_path, capsys, monkeypatch) -> None:
    out = tmp_path / "run"
    words = (
        f"train --data {data} --out {out} --preset {EXAMPLE}:make --loader.batch-size 8 --schedule.steps 6"
    )
    words = f"{words} --schedule.checkpoint-every 3 --loader.validation-fraction 0.2".split()
    assert main(words) == 0
    whole = {path.name: path.read_bytes() for path in out.rglob("model.safetensors")}
    assert {"pick_accuracy", "validation_pick_accuracy"} <= {
        name for line in metrics_of(out) for name in line
    }
    shutil.rmtree(out / "checkpoints" / "2-cloning-000006")
    (out / "checkpoints" / "best.txt").unlink()
    if not (out / "checkpoints" / "2-cloning-000003").is_dir():  # only the best and the latest are kept
        shutil.rmtree(out)
    assert main(words) == 0
    assert {path.name: path.read_bytes() for path in out.rglob("model.safetensors")} == whole
    words = (
        f"evaluate --policy {out} --tasks visual_manipulation --levels L1 --episodes 2 --no-report".split()
    )
    words += ["--out", str(tmp_path / "results")]
    capsys.readouterr()
    assert main(words) == 2
    said = capsys.readouterr().err
    assert str(out / "config.yaml") in said and "--trust-code" in said and "Nothing was executed" in said
    monkeypatch.chdir(tmp_path)  # the run folder names its code by an absolute path
    assert main([*words, "--trust-code", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["episodes"] == 2
    (record,) = Results.read(tmp_path / "results").policies.values()
    assert (record["kind"], record["code"]["source"]) == ("run", "custom_learner.py:make")
    checkpoint = out / "checkpoints" / (out / "checkpoints" / "best.txt").read_text().strip()
    assert OnlineEval(("rotate",), episodes=1)(checkpoint)["success"] in (0, 1)
    assert len(EXAMPLE.read_text().splitlines()) <= 120


def test_what_makes_no_learner_and_its_errors_are_named(monkeypatch, example) -> None:
    import custom_learner

    with pytest.raises(ConfigError, match="builtins:dict returned a dict; it must return a Learner"):
        make_learner("builtins:dict")
    monkeypatch.setattr(custom_learner, "Matcher", None)
    with pytest.raises(ConfigError, match=r"not callable \(custom_learner.py, line \d+\)"):
        make_learner(example)


def test_a_learner_without_its_score_is_named_at_the_first_step(example, settings, monkeypatch) -> None:
    import custom_learner

    monkeypatch.setattr(custom_learner.Matcher, "score", "accuracy")
    with pytest.raises(ConfigError, match=r"score is 'accuracy', but .* pick_accuracy, place_accuracy; name"):
        train(TrainingConfig.of({**settings, "preset": example, "pretraining.steps": 0}))
    assert not (settings["out"] / "metrics.jsonl").exists()


def test_a_custom_learner_has_no_pretraining(example, settings) -> None:
    with pytest.raises(ConfigError, match=r"does not know pretraining\.steps"):
        train(TrainingConfig.of({**settings, "preset": example}))


def test_tied_weights_are_written_and_read(tmp_path) -> None:
    class Tied(Learner):
        def __init__(self) -> None:
            super().__init__()
            self.first = torch.nn.Linear(2, 2)
            self.second = self.first

    written, other = Tied(), Tied()
    written.write(tmp_path)
    other.read(tmp_path)
    assert torch.equal(other.second.weight, written.first.weight)


def test_rollouts_are_logged_with_their_step(settings, monkeypatch) -> None:
    seen, tracked = [], []

    class Noted:
        def add(self, prefix: str, values: dict, step: int) -> None:
            tracked.append((prefix, step, {*values} & {"loss", "rollout_success"}))

        def add_animations(self, prefix: str, animations: list, step: int) -> None:
            ((animation,),) = (animations,)
            assert animation.frames.shape[1:] == (128, 256, 3)
            tracked.append((prefix, step, animation.name))

        def close(self) -> None:
            tracked.append("closed")

    def rollout(checkpoint: Path) -> dict[str, float]:
        seen.append(checkpoint.name)
        return OnlineEval(("rotate",), episodes=1)(checkpoint)

    monkeypatch.setattr("openvima.training.loop.open_trackers", lambda *_: [Noted()])
    config = TrainingConfig.of({**settings, "rollout.every": 4})
    train(config, rollout=rollout, animate=OnlineEval(("rotate",), episodes=1).animate)
    at = tracked.index(("2-cloning", 8, {"rollout_success"}))  # after 4 steps of pretraining
    assert tracked[at + 1] == ("2-cloning", 8, "rotate")
    assert ("1-pretraining", 4, {"loss"}) in tracked
    assert tracked[-1] == "closed"
    assert seen == ["2-cloning-000004"]
    (trial,) = [line for line in metrics_of(config.out) if "rollout_success" in line]
    assert (trial["step"], trial["rollout_rotate"]) == (4, trial["rollout_success"])


def test_a_run_of_epochs_takes_as_many_steps_as_they_have_and_keeps_permanent_checkpoints(settings) -> None:
    """Also between the regular ones."""
    changes = {"pretraining.steps": 0, "schedule.epochs": 1.25, "schedule.checkpoint_every": 3}
    changes |= {"loader.validation_fraction": 0.0, "schedule.keep_every": 2}
    run = train(TrainingConfig.of({**settings, **changes}))  # of 4 steps an epoch
    kept = {folder.name for folder in (run / "checkpoints").glob("2-*")}
    assert kept >= {f"2-cloning-00000{step}" for step in (2, 4, 5)} and "2-cloning-000006" not in kept


def test_a_nan_loss_stops_the_run_and_keeps_the_last_checkpoint(settings, monkeypatch) -> None:
    from openvima.training.behaviour_cloning import BehaviourCloning

    backward = BehaviourCloning.backward

    def exploding(self, step: int) -> dict[str, float]:
        metrics = backward(self, step)
        if step == 3:
            self.parameters[0].grad.fill_(float("nan"))
        return metrics

    monkeypatch.setattr(BehaviourCloning, "backward", exploding)
    with pytest.raises(
        ConfigError, match=r"the gradient is nan at step 3 of 2-cloning.*lower optimizer.learning_rate"
    ):
        train(TrainingConfig.of(settings))
    assert (settings["out"] / "checkpoints" / "2-cloning-000002").is_dir()
