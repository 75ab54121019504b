"""A run folder has one writer, and what a killed one left behind goes with the next."""

import json
import subprocess
import threading

import pytest

from openvima.data import Dataset
from openvima.errors import FolderLockedError
from openvima.training import TrainingConfig, train
from openvima.training.run_folder import (
    git_state,
    provenance,
)
from worker_jobs import holding


def test_a_second_run_in_a_folder_is_refused_at_once_and_writes_nothing(settings) -> None:
    config = TrainingConfig.of(settings)
    with holding(config.out) as process:
        before = sorted(path.name for path in config.out.iterdir())
        with pytest.raises(FolderLockedError, match=rf"by process {process.pid}\b"):
            train(config)
        assert sorted(path.name for path in config.out.iterdir()) == before


def test_a_run_holds_the_lock_until_it_ends(settings) -> None:
    config = TrainingConfig.of({**settings, "pretraining.steps": 0, "schedule.steps": 2})
    refused = threading.Event()

    def second(done: int, total: int, note: str) -> None:
        with pytest.raises(FolderLockedError, match="another thread of this process"):
            train(config)
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


def test_data_are_named_by_their_content(data):
    known = provenance(Dataset(data))["data"]
    assert known["counts"]["episodes"] == 24
    assert len(known["manifest_sha256"]) == 64


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
