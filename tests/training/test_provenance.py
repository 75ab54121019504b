"""Provenance of a run."""

import json
import subprocess

import pytest

pytest.importorskip("torch")

from openvima.data import Dataset
from openvima.training import TrainingConfig, train
from openvima.training.run_folder import git_state, provenance


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
