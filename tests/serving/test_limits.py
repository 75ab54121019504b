"""What one request may ask for: counted before anything is computed, while other clients are answered."""

import logging
import threading
from typing import Any

import pytest

from openvima.policies.base import PromptLimits
from openvima.scene import RenderedPrompt
from openvima.serving import RemotePolicy, serve_in_thread
from openvima.serving.protocol import encode_prompt, pack, unpack
from openvima.serving.server import Session
from served_policies import ForMany, Telltale, made_up_observation, made_up_prompt, told


class Untouched(Telltale):
    """Fails if anything is asked of it."""

    def reset(self, prompts) -> None:
        pytest.fail("the policy was asked")


def refusal(message: Any, policy: Any = None) -> str:
    session = Session(policy or Untouched(), 64)
    answer = session.read(pack(message))
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
    session = Session(policy, 64, "text")
    request = session.read(pack({"type": "reset", "prompts": [encode_prompt(made_up_prompt(3))]}))
    assert not isinstance(request, str)
    assert session.reply(request) == pack({"type": "reset", "episodes": 1})
    (prompt,) = policy.prompts
    assert (prompt.text, prompt.images) == ("Look at the red swirl bowl, number 3.", {})
    long = prompt_with(objects=[{"object_id": 2, "object": "x" * 201, "texture": "red"}])
    assert "names of over 200 characters" in str(session.read(pack({"type": "reset", "prompts": [long]})))


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

    with serve_in_thread(Terse()) as url, RemotePolicy(url) as policy:
        assert policy.metadata["limits"]["prompt_chars"] == 30
    sent = {
        "type": "reset",
        "prompts": [encode_prompt(RenderedPrompt("Put it back where it was before.", {}))],
    }
    assert "32 characters; this policy takes 30" in refusal(sent, Terse())


def test_a_request_that_takes_long_to_read_keeps_nobody_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, finished = threading.Event(), threading.Event()

    def slow(data: bytes) -> Any:
        if data == b"slow":
            reading.set()
            assert finished.wait(10)
        return unpack(data)

    monkeypatch.setattr("openvima.serving.server.unpack", slow)
    with serve_in_thread(ForMany()) as url, RemotePolicy(url) as bad, RemotePolicy(url) as good:
        bad._socket.send(b"slow")
        assert reading.wait(10)
        good.reset([made_up_prompt(3)])
        assert told(good.act([made_up_observation(4)])[0]) == (3, 4, 1)
        finished.set()
        assert "no whole MessagePack" in str(bad._socket.recv())


def test_refusals_are_short_and_hold_no_control_characters(caplog: pytest.LogCaptureFixture) -> None:
    hostile = "\x1b[2J\u202e\n" + "y" * 10_000

    class Failing(Telltale):
        def reset(self, prompts) -> None:
            raise KeyError(hostile)

    session = Session(Failing(), 64)
    request = session.read(pack({"type": "reset", "prompts": [prompt_with()]}))
    assert not isinstance(request, str)
    with caplog.at_level(logging.ERROR):
        answers = [session.reply(request)]
    answers += [
        refusal({"type": hostile}),
        refusal({"type": "reset", hostile: 1}),
        refusal({"type": "reset", "protocol": hostile, "prompts": []}),
        refusal({"type": "reset", "prompts": [prompt_with(kind=hostile)]}),
    ]
    for answer in answers:
        assert isinstance(answer, str)
        assert answer.isprintable() and len(answer) <= 500 and answer.count("y") <= 200 + 10
    assert all(line.isprintable() for line in caplog.text.splitlines()) and "\x1b" not in caplog.text
