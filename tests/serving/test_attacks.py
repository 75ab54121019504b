"""A little of `benchmarks/fuzz_server.py`: the server refuses, and others are answered meanwhile."""

import os
import subprocess
import sys

import pytest

from fuzz_server import attack, memory_mb
from openvima.policies import RandomPolicy
from openvima.serving import serve_in_thread

LARGE = (
    "text of 277 kB",
    "text of 374 kB",
    "unknown word of 1 MB",
    "1,365 placeholders",
    "4,000 records of one object",
)


def test_a_server_withstands_fuzzed_messages_and_large_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("openvima.serving.server.CLOSE_S", 0.1)
    with serve_in_thread(RandomPolicy()) as url:
        found = attack(url, os.getpid(), rounds=200, seed=3, large=LARGE, fragments=5_000)
    assert found["failures_of_others"] == []
    refused = [list(each["answers"]) for each in found["attacks"][1:]]
    assert all("PromptError: the prompt has" in kind[0] for kind in refused[:4])
    assert refused[4] == ["MessageError"] and "fragments" in refused[5][0]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are read from /proc")
def test_a_server_that_has_ended_holds_no_memory() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)  # it stays a zombie
        assert memory_mb(ended.pid, "VmHWM") == 0
