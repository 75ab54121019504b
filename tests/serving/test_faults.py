"""Clients that send nonsense, vanish, dawdle or crowd in: the server lives, says why, and keeps nothing."""

import gc
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random
from typing import Any
from urllib.parse import urlsplit

import msgpack
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
NUM_MALFORMED = 1000


KEYS = (
    "type",
    "prompts",
    "observations",
    "text",
    "images",
    "rgb",
    "ee",
    "top",
    b"data",
    "prompt",
    "protocol",
)
PLAIN = (None, True, -1, 2**64 - 1, 1e300, float("nan"), "text", b"bytes", "", [], {})


class Fuzzer:
    """Makes malformed messages.

    Args:
        good: Proper messages, to damage.
        random: Source of randomness.
    """

    def __init__(self, good: Sequence[bytes], random: Random) -> None:
        self._good = good
        self._random = random

    def message(self) -> bytes | str:
        """Return one of the ways in which a message can be wrong."""
        random = self._random
        ways = (
            lambda: random.randbytes(random.randrange(300)),
            self._cut,
            self._garbled,
            lambda: _packed(["type", self._junk()]),
            lambda: _packed(
                {"type": random.choice(["reset", "act", "", None, 3, "x" * 9999]), "rows": self._junk()}
            ),
            lambda: _packed({"type": "reset", "prompts": [self._junk()]}),
            lambda: _packed({"type": "act", "observations": [self._junk()] * 3}),  # and out of order
            lambda: _packed({"prompt": self._junk(), "rgb": self._array(), "ee": self._junk(1)}),
            lambda: bytes([random.choice(b"\x91\x81\xdc\xdd")]) * random.randrange(1, 5000),
            lambda: (
                random.choice([b"\xdd", b"\xdf", b"\xc6", b"\xdb", b"\xc9"]) + b"\xff" * random.randrange(9)
            ),
            lambda: "text " * random.randrange(9),
        )
        return random.choice(ways)()

    def _cut(self) -> bytes:
        good = self._random.choice(self._good)
        return good[: self._random.randrange(len(good))]

    def _garbled(self) -> bytes:
        bad = bytearray(self._random.choice(self._good))
        for _ in range(self._random.randrange(1, 9)):
            bad[self._random.randrange(min(200, len(bad)))] = self._random.randrange(256)
        return bytes(bad) + b"!"

    def _junk(self, depth: int = 3) -> Any:
        random = self._random
        kind = random.randrange(4) if depth else 0
        if kind == 1:
            return [self._junk(depth - 1) for _ in range(random.randrange(4))]
        if kind == 2:
            return {random.choice(KEYS): self._junk(depth - 1) for _ in range(random.randrange(4))}
        return self._array() if kind == 3 else random.choice(PLAIN)

    def _array(self) -> dict[bytes, Any]:
        random = self._random
        dtypes = ["|O", "O", "<U9", "|V8", "<c16", "<M8[s]", "|S4", "u1,f8", "<f8", "|u1", "x" * 999, 7, None]
        lengths = [0, 1, -1, 3, 2**31, 2**62, -(2**40), 1.5, "3", True, None]
        return {
            b"__ndarray__": True,
            b"data": random.randbytes(random.randrange(9)),
            b"dtype": random.choice(dtypes),
            b"shape": [random.choice(lengths) for _ in range(random.randrange(12))],
        }


def _packed(message: object) -> bytes:
    packed = msgpack.packb(message)
    assert packed is not None
    return packed


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


def test_a_thousand_malformed_messages_are_refused_one_by_one(url: str) -> None:
    fuzzer = Fuzzer(good_messages(), Random(7))
    refusals: Counter[str] = Counter()
    with connect(url, compression=None, proxy=None) as connection:
        connection.recv()
        for number in range(NUM_MALFORMED):
            message = fuzzer.message()
            connection.send(message)
            answer = connection.recv()
            assert isinstance(answer, str), (number, message)
            assert 10 < len(answer) < 600 and "Traceback" not in answer, (number, answer)
            assert answer.startswith("MessageError: "), (number, answer)
            refusals[answer] += 1
        connection.send(good_messages()[0])
        assert unpack(connection.recv()) == {"type": "reset", "episodes": 2}  # type: ignore[arg-type]
    assert len(refusals) > 50
    assert plays(url, 3)


@pytest.mark.slow
def test_nothing_is_left_of_clients_of_any_kind(impatient_url: str) -> None:
    url, random = impatient_url, Random(8)
    fuzzer = Fuzzer(good_messages(), random)

    def crowd() -> None:
        for _ in range(15):
            assert plays(url, 5)
            vanish_within_a_message(url)
            knock(url, random.randbytes(50) + b"\r\n\r\n")
            with connect(url, compression=None, proxy=None) as connection:
                connection.recv()
                connection.send(fuzzer.message())
                connection.recv()

    crowd()
    before = counts_alone(url)
    crowd()
    after = counts_alone(url)
    assert {key: after[key] - before[key] for key in after if after[key] > before[key] + 2} == {}


def counts_alone(url: str) -> dict[str, int]:
    """Count once the server has noticed who has gone: it drops what stays silent for `IDLE_S`."""
    with connect(url, compression=None, proxy=None) as connection:
        connection.recv()
        with pytest.raises(ConnectionClosed):
            connection.recv()
    for _ in range(1000):  # the server may still be closing this very connection
        if not (found := counts())["ServerConnection"]:
            break
        time.sleep(0.01)
    return found


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


def test_clients_at_once_get_their_own_answers_while_others_send_nonsense(url: str) -> None:
    failures: list[object] = []

    def play(number: int) -> None:
        with RemotePolicy(url) as policy:
            for batch in range(4):
                prompts = [made_up_prompt(number), made_up_prompt(number + batch)]
                policy.reset(prompts)
                for step in range(1, 6):
                    actions = policy.act([made_up_observation(step), None])
                    if told(actions[0]) != (number, step, step) or actions[1] is not None:
                        failures.append(actions)

    def disturb(number: int) -> None:
        fuzzer = Fuzzer(good_messages(), Random(number))
        with connect(url, compression=None, proxy=None) as connection:
            connection.recv()
            for _ in range(60):
                connection.send(fuzzer.message())
                if not isinstance(connection.recv(), str):
                    failures.append("nonsense was answered")

    workers = [threading.Thread(target=work, args=(10 * n,)) for n in range(1, 5) for work in (play, disturb)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert failures == []


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
