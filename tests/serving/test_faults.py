"""Clients that send nonsense, vanish, dawdle or crowd in: the server lives, says why, and keeps nothing."""

import gc
import logging
import os
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect

from openvima.errors import ServerError
from openvima.policies.base import PromptLimits
from openvima.scene import RenderedPrompt
from openvima.serving import RemotePolicy, serve_in_thread
from openvima.serving.protocol import encode_observation, encode_prompt, pack
from openvima.serving.server import ServerConfig, Session
from served_policies import ForMany, Telltale, made_up_observation, made_up_prompt, told

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


class Untouched(Telltale):
    """Fails if anything is asked of it."""

    def reset(self, prompts) -> None:
        pytest.fail("the policy was asked")


def refusal(message: Any, policy: Any = None) -> str:
    session = Session(policy or Untouched(), ServerConfig())
    answer = session.answer(pack(message))
    assert isinstance(answer, str)
    return answer


def prompt_with(text: str = "Look at {thing}.", **fields: Any) -> dict[str, Any]:
    sent = encode_prompt(made_up_prompt(1))
    return {"text": text, "images": [{**sent["images"][0], **fields}]}


def test_a_policy_that_reads_language_is_served_descriptions() -> None:
    class Listener(Telltale):
        def reset(self, prompts) -> None:
            self.prompts = prompts

    policy = Listener()
    session = Session(policy, ServerConfig(prompts="text"))
    request = pack({"type": "reset", "prompts": [encode_prompt(made_up_prompt(3))]})
    assert session.answer(request) == pack({"type": "reset"})
    (prompt,) = policy.prompts
    assert (prompt.text, prompt.images) == ("Look at the red swirl bowl, number 3.", {})
    long = prompt_with(objects=[{"object_id": 2, "object": "x" * 201, "texture": "red"}])
    assert "names of over 200 characters" in str(session.answer(pack({"type": "reset", "prompts": [long]})))


def records(*ids: int) -> list[dict[str, Any]]:
    return [{"object_id": number, "object": "bowl", "texture": "red"} for number in ids]


def test_every_count_of_a_prompt_is_bounded_before_the_policy_sees_it() -> None:
    names = [f"i{n}" for n in range(65)]
    many = {
        "text": " ".join(f"{{{n}}}" for n in names),
        "images": [prompt_with(name=n)["images"][0] for n in names],
    }
    few = {"text": "{a}" * 65, "images": prompt_with(name="a")["images"]}
    full = {
        "text": "{a} {b}",
        "images": [prompt_with(name=n, objects=records(*range(200)))["images"][0] for n in "ab"],
    }
    for sent, reason in (
        (
            {"text": "put the " * 50_000},
            "PromptError: the prompt has 400,000 characters; this policy takes 4,096.",
        ),
        (many, "65 images; this policy takes 64"),
        (few, "65 images; this policy takes 64"),
        (full, "400 objects; this policy takes 256"),
        (prompt_with(objects=records(256)), "object_id is 256; it must lie in 0 … 255"),
        (prompt_with(objects=records(2**63)), "must lie in 0 … 255"),
    ):
        assert reason in refusal({"type": "reset", "prompts": [sent]})
        assert reason in refusal({**made_up_observation(1), "prompt": sent})


def test_a_policy_states_its_own_limits() -> None:
    class Terse(ForMany):
        prompt_limits = PromptLimits(chars=30)

    sent = {
        "type": "reset",
        "prompts": [encode_prompt(RenderedPrompt("Put it back where it was before.", {}))],
    }
    assert "32 characters; this policy takes 30" in refusal(sent, Terse())


def test_refusals_are_short_and_hold_no_control_characters(caplog: pytest.LogCaptureFixture) -> None:
    hostile = "\x1b[2J\u202e\n" + "y" * 10_000

    class Failing(Telltale):
        def reset(self, prompts) -> None:
            raise KeyError(hostile)

    session = Session(Failing(), ServerConfig())
    with caplog.at_level(logging.ERROR):
        answers = [session.answer(pack({"type": "reset", "prompts": [prompt_with()]}))]
    answers += [
        refusal({"type": hostile}),
        refusal({"type": "reset", hostile: 1}),
        refusal({"type": "reset", "prompts": [prompt_with(kind=hostile)]}),
    ]
    for answer in answers:
        assert isinstance(answer, str)
        assert answer.isprintable() and len(answer) <= 500 and answer.count("y") <= 200 + 10
    assert all(line.isprintable() for line in caplog.text.splitlines()) and "\x1b" not in caplog.text
