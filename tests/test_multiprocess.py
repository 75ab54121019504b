"""Jobs in several processes: none outlives its parent, and the parent learns how each ended."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import worker_jobs
from openvima import multiprocess
from openvima.errors import SceneError, WorkerError
from openvima.multiprocess import imap_unordered


def wait_until(condition: Callable[[], bool], timeout_s: float = 120) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.01)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/stat")
    return not (status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z")


def test_all_jobs_run_on_one_thread_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
    counts = []
    paths = [tmp_path / str(k) for k in range(3)]
    list(imap_unordered(worker_jobs.write_number, paths, 2, report=counts.append))
    assert [path.read_text() for path in paths] == ["1"] * 3
    assert counts[-1] == 9
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MALLOC_TRIM_THRESHOLD_" not in os.environ


def test_an_error_of_a_job_reaches_the_caller() -> None:
    with pytest.raises(SceneError, match="job 1 fails"):
        list(imap_unordered(worker_jobs.fail, [0, 1, 2], 2, report=lambda count: None))


def test_a_killed_worker_is_reported() -> None:
    with pytest.raises(WorkerError, match="was killed"):
        list(imap_unordered(worker_jobs.die, [0, 1, 2], 2, report=lambda count: None))


@pytest.mark.parametrize("way", ["file", "standard input"])
def test_a_script_without_a_guard_is_named_and_not_a_lack_of_memory(tmp_path: Path, way: str) -> None:
    """Workers import the script, which would start workers again; standard input they cannot import."""
    script = tmp_path / "script.py"
    script.write_text(
        "import worker_jobs; from openvima.multiprocess import imap_unordered\n"
        "list(imap_unordered(worker_jobs.fail, [0, 2], 2))\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with script.open() as stdin:
        words = [sys.executable, str(script) if way == "file" else "-"]
        ended = subprocess.run(
            words, env=environment, stdin=stdin, capture_output=True, text=True, check=False
        )
    (last,) = ended.stderr.splitlines()[-1:]
    assert last.startswith("openvima.errors.WorkerError: the worker processes could not start.")
    assert 'if __name__ == "__main__":' in last and "memory" not in last


@pytest.mark.slow
def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    paths = [tmp_path / "a", tmp_path / "b"]
    code = (
        "import sys, pathlib, worker_jobs; from openvima.multiprocess import imap_unordered\n"
        "if __name__ == '__main__':\n"
        "    paths = [pathlib.Path(p) for p in sys.argv[1:]]\n"
        "    list(imap_unordered(worker_jobs.note_pid_and_hang, paths, 2))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(code)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen(
        [sys.executable, str(script), *map(str, paths)], env=environment, stderr=subprocess.DEVNULL
    )
    try:
        wait_until(lambda: all(path.exists() for path in paths))
    finally:
        parent.kill()
        parent.wait()
    workers = [int(path.read_text()) for path in paths]
    try:
        wait_until(lambda: not any(is_alive(pid) for pid in workers))
    finally:
        for pid in filter(is_alive, workers):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize(
    ("quota", "count"), [("max", 64), ("100000", 1), ("150000", 2), ("x", 64), (None, 64)]
)
def test_the_quota_of_a_container_bounds_the_number_of_cpus(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quota: str | None, count: int
) -> None:
    if quota is not None:
        (tmp_path / "cpu.max").write_text(f"{quota} 100000\n")
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(64))
    monkeypatch.setattr(multiprocess, "_CPU_QUOTA", tmp_path / "cpu.max")
    assert multiprocess.num_cpus() == count
