"""The verb `serve`, and a server that knows nothing of openvima, as programs of their own."""

import functools
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import pytest

from openvima.cli.main import main
from openvima.serving import RemotePolicy
from openvima.serving.protocol import TOKEN_VARIABLE

EXAMPLE = Path(__file__).parents[2] / "examples" / "policy_server.py"
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


@contextmanager
def program(*words: str, **variables: str) -> Iterator[subprocess.Popen[str]]:
    """Run Python until the end of the block."""
    started = subprocess.Popen(
        [sys.executable, *words],
        env=ENVIRONMENT | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # What a shell starts in the background ignores Ctrl-C, and so do its children.
        preexec_fn=functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )
    with started:
        try:
            yield started
        finally:
            started.kill()


def test_serve_prints_its_address_answers_and_ends_with_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("-m", "openvima", "serve", "random", "--port", "0", "--name", "dice")
    with program(*words, **{TOKEN_VARIABLE: "secret"}) as server:
        assert server.stdout is not None and server.stderr is not None
        url = server.stdout.readline().strip()
        with urlopen(url.replace("ws", "http", 1) + "/healthz") as response:
            assert (response.status, response.read()) == (200, b"OK\n")
        monkeypatch.setenv(TOKEN_VARIABLE, "secret")
        policy = RemotePolicy(url)
        assert policy.metadata["policy"] == {"name": "dice", "kind": "random", "device": "cpu"}
        assert set(policy.metadata["versions"]) == {"openvima", "numpy"}
        server.send_signal(signal.SIGINT)
        assert server.wait(timeout=120) == 130
        logged = server.stderr.read()
        assert "connected" in logged and logged.endswith("goodbye.\n") and "Traceback" not in logged
        policy.close()


def test_evaluating_a_server_that_is_not_there_is_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    assert main(["evaluate", "--policy", f"ws://127.0.0.1:{port}", "--out", str(tmp_path / "new")]) == 1
    assert re.search(f"127.0.0.1:{port}.*openvima serve RUN", capsys.readouterr().err)
    assert not (tmp_path / "new").exists()


def test_the_example_is_short_and_is_scored_without_openvima(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len(EXAMPLE.read_text(encoding="utf-8").splitlines()) < 40
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    start = f"import sys, runpy; sys.modules['openvima'] = None; sys.argv = ['example', {port!r}]; "
    with program("-c", start + f"runpy.run_path({str(EXAMPLE)!r}, run_name='__main__')") as server:
        wait_for_port(int(port), server)
        words = ["--tasks", "visual_manipulation", "--levels", "L1", "--episodes", "2", "--no-report"]
        words += ["--json", "--out", str(tmp_path)]
        assert main(["evaluate", "--policy", f"mine=ws://127.0.0.1:{port}", *words]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["policy"], row["episodes"]) == ("mine", 2)
    assert all(outcome["kind"] != "invalid action" for outcome in row["outcomes"])
    policies = json.loads((tmp_path / "results.json").read_text())["policies"]
    assert policies["mine"]["metadata"]["policy"] == {"name": "into-the-largest"}


def wait_for_port(port: int, server: subprocess.Popen[str]) -> None:
    while server.poll() is None:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=10).close()
            return
        except ConnectionRefusedError:
            os.sched_yield()
    pytest.fail(f"the example ended: {server.communicate()[1]}")
