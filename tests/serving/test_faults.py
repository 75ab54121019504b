"""Clients that send nonsense, vanish, dawdle or crowd in: the server lives, says why, and keeps nothing."""

import gc
import os
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect

from openvima.errors import ServerError
from openvima.serving import RemotePolicy, serve_in_thread
from openvima.serving.protocol import encode_observation, encode_prompt, pack, unpack
from served_policies import ForMany, made_up_observation, made_up_prompt, told

SETTINGS = {"max_message_bytes": 2**18}
IDLE_S = 0.3  # where silence is the subject; on a busy machine it would end other connections


@pytest.fixture
def url() -> Iterator[str]:
    with serve_in_thread(ForMany(), **SETTINGS) as url:
        yield url


@pytest.fixture
def impatient_url() -> Iterator[str]:
    with serve_in_thread(ForMany(), **SETTINGS, idle_s=IDLE_S) as url:
        yield url


def plays(url: str, number: int) -> bool:
    """Whether the server answers as it should."""
    with RemotePolicy(url) as policy:
        policy.reset([made_up_prompt(number)])
        return told(policy.act([made_up_observation(7)])[0]) == (number, 7, 1)


def good_messages() -> list[bytes]:
    prompt, seen = encode_prompt(made_up_prompt(1)), encode_observation(made_up_observation(2))
    return [
        pack({"type": "reset", "prompts": [prompt] * 2}),
        pack({"type": "act", "observations": [seen, None]}),
        pack({**(seen or {}), "prompt": prompt}),
    ]


def counts() -> dict[str, int]:
    """Open files, threads, tasks and sessions of this process, which is the server's, too."""
    gc.collect()
    objects = Counter(type(each).__name__ for each in gc.get_objects())
    files = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else 0
    kinds = ("Session", "ForMany", "ServerConnection", "Task", "Future")
    return {"files": files, "threads": threading.active_count(), **{kind: objects[kind] for kind in kinds}}


def knock(url: str, data: bytes) -> bytes:
    """Send bytes that are no WebSocket; return the answer's beginning."""
    with socket.create_connection(urlsplit(url).netloc.split(":"), timeout=10) as raw:  # type: ignore[arg-type]
        raw.sendall(data)
        return raw.recv(100)


def vanish_within_a_message(url: str) -> None:
    """Go away without a word after half a frame."""
    with connect(url, compression=None, proxy=None, close_timeout=0.01) as connection:
        connection.recv()
        frame = Frame(Opcode.BINARY, good_messages()[0]).serialize(mask=True)
        connection.socket.sendall(frame[: len(frame) // 2])
        connection.socket.shutdown(socket.SHUT_RDWR)


def test_a_client_that_vanishes_within_a_message_disturbs_nobody(url: str) -> None:
    with RemotePolicy(url) as policy:
        policy.reset([made_up_prompt(4)])
        vanish_within_a_message(url)
        assert told(policy.act([made_up_observation(1)])[0]) == (4, 1, 1)
    assert plays(url, 2)


def test_what_is_no_websocket_is_turned_away(url: str) -> None:
    assert knock(url, b"GET / HTTP/1.1\r\nHost: x\r\n\r\n").startswith(b"HTTP/1.1 426")
    assert not knock(url, b"\x16\x03\x01\r\n\r\n").startswith(b"HTTP/1.1 101")
    assert plays(url, 2)


def test_a_slow_client_is_dropped_with_a_reason_and_holds_up_nobody(impatient_url: str) -> None:
    url = impatient_url
    frame = Frame(Opcode.BINARY, good_messages()[0]).serialize(mask=True)
    with connect(url, compression=None, proxy=None) as slow:
        slow.recv()
        slow.socket.sendall(frame[:100])  # and never the rest
        assert plays(url, 6)
        with pytest.raises(ConnectionClosed, match=r"no whole message within 0\.3 s"):
            slow.recv()


def test_a_slow_sender_within_the_time_is_served(url: str) -> None:
    frame = Frame(Opcode.BINARY, good_messages()[0]).serialize(mask=True)
    with connect(url, compression=None, proxy=None) as slow:
        slow.recv()
        for start in range(0, len(frame), 50):
            slow.socket.sendall(frame[start : start + 50])
        assert unpack(slow.recv())["episodes"] == 2  # type: ignore[arg-type]


def test_a_client_that_goes_while_the_policy_thinks_is_forgotten() -> None:
    thinking, answered = threading.Event(), threading.Event()

    class Slow(ForMany):
        def new_session(self) -> "Slow":
            return Slow()

        def act(self, observations):
            thinking.set()
            assert answered.wait(10)
            return super().act(observations)

    with serve_in_thread(Slow(), max_connections=1) as url:
        with connect(url, compression=None, proxy=None) as connection:
            connection.recv()
            connection.send(good_messages()[0])
            connection.recv()
            connection.send(good_messages()[1])
            assert thinking.wait(10)
        answered.set()
        for _ in range(1000):  # until the server has noticed
            try:
                assert plays(url, 3)
            except ServerError as error:
                assert "has its one client" in str(error)
            else:
                break
        else:
            pytest.fail("the place of a client that had gone was never free again")


@pytest.mark.slow
def test_a_server_that_stops_leaves_nothing_behind() -> None:
    before = counts()
    for _ in range(3):
        with serve_in_thread(ForMany()) as url:
            assert plays(url, 1)
            with connect(url, proxy=None) as connection:
                connection.recv()
    after = counts()
    assert {key: after[key] - before[key] for key in after if after[key] > before[key] + 2} == {}
