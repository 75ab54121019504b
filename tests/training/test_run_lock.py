"""A run folder has one writer, and what a killed one left behind goes with the next."""

import subprocess
import sys
import threading

import pytest

torch = pytest.importorskip("torch")

from lock_holders import holding  # noqa: E402
from openvima.errors import FolderLockedError  # noqa: E402
from openvima.training import TrainingConfig, train  # noqa: E402
from openvima.training.run_folder import RunFolder  # noqa: E402


def test_a_second_run_in_a_folder_is_refused_at_once_and_writes_nothing(settings) -> None:
    config = TrainingConfig.of(settings)
    with holding(config.out) as process:
        before = sorted(path.name for path in config.out.iterdir())
        with pytest.raises(FolderLockedError, match=rf"process {process.pid} on .* for 0 min"):
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


def test_temporary_files_of_a_killed_run_go_with_the_next(tmp_path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    RunFolder(tmp_path, {"a": 1})
    leftover = tmp_path / "checkpoints" / f".best.txt.{ended.pid}.tmp"
    leftover.write_text("half")
    RunFolder(tmp_path, {"a": 1})
    assert not leftover.exists()
