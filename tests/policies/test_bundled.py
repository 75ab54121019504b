"""Bundled checkpoints by name. Most tests replace the checkpoint with a small network."""

import shutil
from pathlib import Path

import pytest
import torch

from openvima.cli import quickstart
from openvima.env.config import DEFAULT_ENV_CONFIG
from openvima.errors import InputFileError, UnknownPolicyError
from openvima.evaluation import Results
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.evaluation.sources import weights_hash
from openvima.policies import load_policy
from openvima.policies.build import build_network
from openvima.policies.checkpoint import load_checkpoint, save_checkpoint
from openvima.policies.naming import (
    BUNDLED,
    MODEL_CARD,
    SMALL,
    find_checkpoint,
)
from openvima.report import videos
from small_networks import narrow_small


@pytest.fixture
def bundled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a small network in float16 that replaces the bundled checkpoint.

    The working directory is another, empty one.
    """
    folder, elsewhere = tmp_path / "package", tmp_path / "elsewhere"
    save_checkpoint(build_network(narrow_small(), seed=5), folder, dtype=torch.float16)
    (folder / MODEL_CARD).write_text("# A card")
    monkeypatch.setitem(BUNDLED, SMALL, folder)
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    return folder


def test_it_is_loaded_by_its_name_and_never_computes_in_float16(bundled: Path, demonstrations) -> None:
    expected = load_checkpoint(bundled).state_dict()
    policy = load_policy(SMALL)
    floats = [t for t in [*policy.network.parameters(), *policy.network.buffers()] if t.is_floating_point()]
    assert {tensor.dtype for tensor in floats} == {torch.float64}
    assert all(torch.equal(tensor, expected[name]) for name, tensor in policy.network.state_dict().items())
    assert load_policy(SMALL, dtype=torch.float32).network.query.dtype == torch.float32
    policy.reset([demonstrations[0].prompt])
    policy.act([demonstrations[0].observation(0)])


def test_the_message_for_an_unknown_name_lists_the_bundled_checkpoint(bundled: Path) -> None:
    with pytest.raises(
        UnknownPolicyError,
        match=r"Did you mean 'openvima-small'\?.*openvima-small, openvima-vima, untrained:",
    ):
        load_policy("openvima-smal")
    for find in (weights_hash, find_checkpoint):
        with pytest.raises(InputFileError, match="openvima-small"):
            find("something")


def test_quickstart_scores_it_beside_the_policy_that_it_trains(
    bundled: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setattr(quickstart, "TASKS", ("rotate",))
    monkeypatch.setattr(quickstart, "LEVELS", ("L1",))
    monkeypatch.setattr("openvima.data.generate", lambda *_: Path("demonstrations"))
    trained = lambda *_, **__: shutil.copytree(bundled, "quick/trained")  # noqa: E731
    monkeypatch.setattr("openvima.cli.train.train_in_processes", trained)
    monkeypatch.setattr(videos, "recordings", lambda *_: [])  # other tests record
    quickstart.main(out=Path("quick"), episodes=1, workers=1)
    shown = capsys.readouterr().out
    names = ["trained", SMALL, "oracle", "untrained", "random"]
    assert all(name in shown for name in names) and "Report: " in shown
    assert list(Results.read(Path("quick", "results.json")).policies) == names
    assert SMALL in Path("quick", "report.html").read_text(encoding="utf-8")


def test_the_weights_of_the_package_solve_tasks_with_novel_objects() -> None:
    policy = load_policy(SMALL)
    assert sum(parameter.numel() for parameter in policy.network.parameters()) <= 10_000_000
    solved = []
    for task in ("visual_manipulation", "rotate", "rearrange"):
        envs = [DEFAULT_ENV_CONFIG.make(task, "L3", domain="user") for _ in range(4)]
        solved += [outcome.success for outcome in play(envs, range(4), PromptedRolloutPolicy(policy))]
    assert sum(solved) >= 9
