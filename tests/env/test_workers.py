"""Workers: what an error, a kill or Ctrl-C does to them, and what they leave behind."""

import functools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import pytest
from gymnasium.vector import AutoresetMode

from faulty_environments import FailsToStart, Faulty
from openvima.env import stack_actions
from openvima.env.vector import TabletopVectorEnv
from openvima.errors import SamplingError, WorkerError

IDLE = stack_actions([None, None])
SCRIPT = """
import mujoco  # starts a process that looks for a graphics library, and is none of ours
import openvima
from openvima.env import stack_actions

def main():
    print("starting", flush=True)
    envs = openvima.make_vec("rotate", 2, num_workers=2)
    envs.reset(seed=0)
    print(*[process.pid for process in envs.processes], flush=True)
    while True:
        envs.step(stack_actions([None, None]))

if __name__ == "__main__":
    main()
"""


def build(env_fn: Callable[[], gymnasium.Env] = Faulty) -> TabletopVectorEnv:
    mode = AutoresetMode.NEXT_STEP
    return TabletopVectorEnv([env_fn, env_fn], [(), ()], mode, num_workers=2)


Start = Callable[[str], subprocess.Popen]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Run a script as the leader of a group of processes, as a terminal does; it ends with the test."""
    processes: list[subprocess.Popen] = []

    def run(script: str) -> subprocess.Popen:
        file = tmp_path / "script.py"
        file.write_text(script, encoding="utf-8")
        process = subprocess.Popen(
            [sys.executable, str(file)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            # In the background of a shell the tests, and so the script, would ignore Ctrl-C.
            preexec_fn=functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
        )
        processes.append(process)
        return process

    yield run
    for process in processes:
        process.kill()
        process.communicate()


def is_running(pid: int) -> bool:
    """Whether a process exists and is no zombie, which a container without an init process keeps."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rsplit(")")[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def wait_until_gone(pids: list[int]) -> None:
    deadline = time.monotonic() + 120
    while any(map(is_running, pids)):
        assert time.monotonic() < deadline, f"{[pid for pid in pids if is_running(pid)]} still run"
        time.sleep(0.02)


@pytest.mark.slow
def test_an_error_in_a_worker_reaches_the_caller_and_ends_all() -> None:
    envs = build()
    envs.reset(seed=[1, 2])
    with pytest.raises(SamplingError, match="no place for the target") as caught:
        envs.reset(seed=[1, 13])
    assert caught.value.__notes__[0] == "raised in sub-environment 1"
    assert "faulty_environments.py" in caught.value.__notes__[1]  # its traceback
    assert not any(process.is_alive() for process in envs.processes)
    with pytest.raises(gymnasium.error.ClosedEnvironmentError):
        envs.step(IDLE)
    envs.close()


@pytest.mark.slow
def test_a_killed_worker_is_reported_and_ends_all() -> None:
    envs = build()
    envs.reset(seed=0)
    victim = envs.processes[1]
    os.kill(victim.pid, signal.SIGKILL)
    victim.join()
    with pytest.raises(WorkerError, match=r"sub-environment 1 \(exit code -9\) died; "):
        envs.step(IDLE)
    assert not any(process.is_alive() for process in envs.processes)
    envs.close()


def test_a_worker_that_does_not_start_is_reported() -> None:
    with pytest.raises(WorkerError, match=r"0 \(exit code 3\).* died.*__main__"):
        build(FailsToStart())


@pytest.mark.slow
def test_ctrl_c_ends_everything_with_one_traceback(start: Start) -> None:
    process = start(SCRIPT)
    assert process.stdout.readline() == "starting\n"
    workers = [int(pid) for pid in process.stdout.readline().split()]
    assert len(workers) == 2
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == -signal.SIGINT
    assert errors.count("Traceback") == 1
    assert errors.endswith("KeyboardInterrupt\n")
    wait_until_gone(workers)


def test_ctrl_c_while_workers_start_ends_them(start: Start) -> None:
    process = start(SCRIPT)
    process.stdout.readline()
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    while len(pids := children.read_text(encoding="utf-8").split()) < 3:  # a third one counts resources
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=300)
    assert errors.count("Traceback") == 1
    assert errors.endswith("KeyboardInterrupt\n")
    wait_until_gone([int(pid) for pid in pids])


@pytest.mark.slow
def test_workers_do_not_outlive_their_parent(start: Start) -> None:
    process = start(SCRIPT)
    process.stdout.readline()
    workers = [int(pid) for pid in process.stdout.readline().split()]
    process.kill()
    _, errors = process.communicate(timeout=300)
    assert "Traceback" not in errors
    wait_until_gone(workers)
