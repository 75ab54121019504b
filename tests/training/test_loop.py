"""Whole runs: resuming, differing settings, content of the run folder."""

import json
import subprocess
import threading

import pytest
import torch

from openvima.data import Dataset
from openvima.errors import ConfigError, DatasetError, FolderLockedError
from openvima.policies import load_policy
from openvima.training import TrainingConfig, train
from openvima.training.behaviour_cloning import BehaviourCloning
from openvima.training.config import ScheduleConfig
from openvima.training.loop import learning_rate_at, step_seed
from openvima.training.run_folder import (
    git_state,
)
from small_data_sets import contents
from small_networks import metrics_of, train_until


@pytest.mark.slow
def test_metrics_have_stage_and_step_and_no_times_and_are_not_logged_twice(settings):
    config = TrainingConfig.of(settings)
    train_until(config, 7)
    with (config.out / "metrics.jsonl").open("a") as lines:
        lines.write('{"stage": 1, "step": 3, "name": "2-cloning", "loss": 1.0}\n{"stage": 1, "st')
    train(config)
    lines = metrics_of(config.out)
    steps = [(line["stage"], line["name"], line["step"]) for line in lines if "loss" in line]
    assert steps == [
        *((0, "1-pretraining", step) for step in (2, 4)),
        *((1, "2-cloning", step) for step in (2, 4, 6)),
    ]
    assert not any("second" in key for line in lines for key in line)


@pytest.mark.slow
def test_nothing_is_held_out_against_tasks_that_have_not_been_shown(settings):
    early = {"pretraining.steps": 0, "loader.first_tasks": "rotate", "loader.first_steps": 2}
    config = TrainingConfig.of({**settings, **early})
    train(config)
    lines = [line for line in metrics_of(config.out) if "validation_score" in line]
    assert [line["step"] for line in lines] == [4, 6]


def test_it_warns_of_overfitting_once_held_out_demonstrations_gain_nothing(settings, monkeypatch, caplog):
    scores, backward = iter((0.5, 0.6, 0.6)), BehaviourCloning.backward
    right = {"accuracy": 0.9}
    monkeypatch.setattr(BehaviourCloning, "backward", lambda self, step: {**backward(self, step), **right})
    monkeypatch.setattr(
        BehaviourCloning, "validate", lambda _: dict.fromkeys(("score", "accuracy"), next(scores))
    )
    train(TrainingConfig.of({**settings, "pretraining.steps": 0}))
    (warning,) = (each.getMessage() for each in caplog.records if each.levelname == "WARNING")
    assert warning.startswith("step 6: accuracy is 90% in training and 60% on held-out demonstrations")


@pytest.mark.slow
def test_differing_settings_are_named_and_force_starts_anew(settings):
    train(TrainingConfig.of(settings))
    changed = {**settings, "schedule.steps": 2, "optimizer.learning_rate": 5e-4}
    differing = r"training\.optimizer\.learning_rate is .*; training\.schedule\.steps is 6 there and 2 here"
    with pytest.raises(ConfigError, match=differing):
        train(TrainingConfig.of(changed))
    run = train(TrainingConfig.of({**changed, "force": True}))
    assert [folder.name for folder in (run / "checkpoints").iterdir() if folder.is_dir()] == [
        "2-cloning-000002"
    ]


def test_a_folder_with_other_files_is_never_cleared(settings):
    settings["out"].mkdir()
    (settings["out"] / "thesis.tex").write_text("years of work")
    with pytest.raises(ConfigError, match="other files"):
        train(TrainingConfig.of(settings))
    with pytest.raises(ConfigError, match="other files"):
        train(TrainingConfig.of({**settings, "force": True}))
    assert (settings["out"] / "thesis.tex").exists()


def test_without_demonstrations_the_error_says_how_to_make_some(settings, tmp_path):
    with pytest.raises(DatasetError, match="openvima generate"):
        train(TrainingConfig.of({**settings, "data": tmp_path / "nothing"}))
    assert not settings["out"].exists()


def test_a_run_keeps_its_last_checkpoint_and_the_best_and_leaves_global_state_alone(settings):
    torch.manual_seed(3)
    expected, threads = torch.rand(2), torch.get_num_threads()
    torch.manual_seed(3)
    run = train(TrainingConfig.of(settings))
    assert torch.equal(torch.rand(2), expected)
    assert torch.get_num_threads() == threads
    kept = {folder.name for folder in (run / "checkpoints").iterdir() if folder.is_dir()}
    assert kept == {"2-cloning-000006", (run / "checkpoints" / "best.txt").read_text()}
    load_policy(str(run))
    superseded = run / "checkpoints" / "2-cloning-000001"  # killed before it was deleted
    superseded.mkdir()
    train(TrainingConfig.of(settings))
    assert not superseded.exists() and (run / "checkpoints" / "2-cloning-000006").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"preset": "vima-2m"}, "'vima-2m' encodes prompts with T5.*model.text_encoder"),
        (
            {"preset": "gato-nano", "pretraining.steps": 5},
            "'gato-nano' takes whole frames, as 'patches'",
        ),
    ],
)
def test_settings_that_contradict_the_preset_leave_no_run_folder(settings, change, message):
    with pytest.raises(ConfigError, match=message):
        train(TrainingConfig.of({**settings, **change}))
    assert not settings["out"].exists()


def shares(steps: int, warmup_steps: int) -> list[float]:
    return [
        learning_rate_at(step, ScheduleConfig(warmup_steps=warmup_steps), peak=1.0, num_steps=steps)
        for step in range(steps)
    ]


@pytest.mark.parametrize(("steps", "warmup_steps"), [(1, 100), (2, 1), (7, 100), (300, 20), (300, 0)])
def test_the_rate_rises_to_its_peak_and_then_only_falls(steps: int, warmup_steps: int) -> None:
    values, peak = shares(steps, warmup_steps), min(warmup_steps, steps // 3)
    assert values[peak] == max(values) == 1 and min(values) > 0
    assert values == sorted(values[:peak]) + sorted(values[peak:], reverse=True)


def test_the_rise_is_a_line_and_the_fall_half_a_cosine() -> None:
    values, schedule = shares(100, 9), ScheduleConfig(warmup_steps=9)
    assert values[:9] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
    assert learning_rate_at(55, schedule, peak=1, num_steps=101) == pytest.approx(0.5)
    assert learning_rate_at(100, schedule, peak=1, num_steps=100) == pytest.approx(0)
    assert learning_rate_at(1000, schedule, peak=1, num_steps=100) == pytest.approx(0)


def test_the_fall_may_end_early_and_above_zero() -> None:
    schedule = ScheduleConfig(warmup_steps=7000, decay_steps=17_000, final_learning_rate=1e-7)
    settings = {"schedule": schedule, "peak": 1e-4, "num_steps": 47_000}
    assert learning_rate_at(7000, **settings) == pytest.approx(1e-4)
    assert learning_rate_at(15_500, **settings) == pytest.approx((1e-4 + 1e-7) / 2)
    assert learning_rate_at(24_000, **settings) == learning_rate_at(46_999, **settings) == 1e-7
    short = {**settings, "num_steps": 9000}  # then the warm-up is a third, and the fall ends with the run
    assert learning_rate_at(3000, **short) == pytest.approx(1e-4)
    assert learning_rate_at(9000, **short) == pytest.approx(1e-7)


def test_seeds_differ_between_runs_purposes_and_steps_and_stay_the_same_for_ever() -> None:
    drawn = {
        step_seed(seed, purpose, step) for seed in (0, 1) for purpose in ("a", "b") for step in range(50)
    }
    assert len(drawn) == 200
    assert all(0 <= seed < 2**63 for seed in drawn)
    assert step_seed(0, "order", 0) == 3471081512423777433  # resumed runs rely on it


def test_a_second_run_in_a_folder_is_refused_at_once_and_writes_nothing(settings) -> None:
    config = TrainingConfig.of({**settings, "pretraining.steps": 0, "schedule.steps": 2})
    refused = threading.Event()

    def second(done: int, total: int, note: str) -> None:
        before = contents(config.out).keys()
        with pytest.raises(FolderLockedError, match="another thread of this process"):
            train(config)
        assert contents(config.out).keys() == before
        refused.set()

    train(config, second)
    assert refused.is_set()
    assert not list(config.out.glob(".lock*"))


@pytest.mark.slow
def test_every_session_of_a_run_is_logged(settings, data):
    config = TrainingConfig.of({**settings, "schedule.checkpoint_every": 3})
    train(config)
    train(config)
    lines = [json.loads(line) for line in (config.out / "sessions_log.jsonl").read_text().splitlines()]
    assert [(line["stage"], line["step"]) for line in lines] == [(0, 0), (1, 6)]
    assert all(line["data"]["content_hash"] == Dataset(data).manifest["content_hash"] for line in lines)
    assert {"openvima", "torch", "numpy"} <= set(lines[0]["versions"])


def test_the_commit_of_a_checkout_is_known_and_elsewhere_nothing(tmp_path):
    assert git_state(tmp_path) is None
    run = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    (tmp_path / "file").write_text("one")
    for words in (["init", "-q"], ["add", "file"], ["commit", "-qm", "One"]):
        subprocess.run([*run, *words], check=True)
    state = git_state(tmp_path)
    assert state is not None
    assert len(state["commit"]) == 40
    assert not state["changed"]
    (tmp_path / "file").write_text("two")
    assert git_state(tmp_path) == {**state, "changed": True}
