"""Servers that are not there, speak otherwise, fall silent or break off: the client says which, and what."""

import socket

import numpy as np
import pytest

from openvima.errors import ConfigError, PolicyError, ServerError
from openvima.serving import PROTOCOL, RemotePolicy, serve_in_thread
from openvima.serving.protocol import TOKEN_VARIABLE
from served_policies import (
    ForMany,
    Telltale,
    made_up_observation,
    made_up_prompt,
    scripted_server,
    told,
)

RESET = {"type": "reset", "episodes": 1}


def shorten(policy: RemotePolicy, timeout_s: float) -> None:
    """Wait for so long from now on: on a busy machine, a handshake may take longer."""
    policy._timeout_s = timeout_s


def port_of(url: str) -> int:
    return int(url.rpartition(":")[2])


@pytest.mark.parametrize(
    "url",
    ["http://127.0.0.1:8000", "ws://", "ws://:8000", "ws://host:port", "ws://host:99999"],
)
def test_what_is_no_address_is_named(url: str) -> None:
    with pytest.raises(ConfigError, match="ws://HOST:PORT"):
        RemotePolicy(url)


def test_the_token_comes_from_the_variable_or_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    with serve_in_thread(ForMany(), token="secret") as url:
        for token in (None, "wrong"):
            with pytest.raises(ServerError, match=f"HTTP 401.*{TOKEN_VARIABLE}"):
                RemotePolicy(url, token=token)
        RemotePolicy(url, token="secret").close()
        monkeypatch.setenv(TOKEN_VARIABLE, "secret")
        RemotePolicy(url).close()


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"protocol": "openvima-policy/2"}, f"protocol is 'openvima-policy/2'; allowed: {PROTOCOL}"),
        ({"hello": "other server"}, "protocol is None"),
        ([1], "is a list; it must be a map"),
        ("not now", "refuses: not now"),
        ({"protocol": PROTOCOL, "mean": np.zeros(3)}, "other than plain, finite values"),
        ({"protocol": PROTOCOL, "score": float("nan")}, "other than plain, finite values"),
        (
            {"protocol": PROTOCOL, "policy": {"scores": [1.0, float("-inf")]}},
            "other than plain, finite values",
        ),
    ],
)
def test_a_server_of_another_protocol_is_told_apart(metadata: object, message: str) -> None:
    with scripted_server(metadata=metadata) as url, pytest.raises(ServerError, match=message):
        RemotePolicy(url)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ("no, thanks", "refuses: no, thanks"),
        (b"\xc1", f"does not keep to {PROTOCOL}"),
        ([], "is a list; it must be a map"),
        ({"type": "reset"}, "type of the answer is 'reset'; allowed: act"),
        ({"type": "act"}, "lacks 'actions'"),
        ({"type": "act", "actions": []}, "must be 1"),
        ({"type": "act", "actions": [3]}, "action 0 is 3; it must be a map"),
        ({"type": "act", "actions": [None], "near_ties": 3}, "near_ties"),
        ({"type": "act", "actions": [None], "extra": 3}, "'extra', which nobody knows"),
        (b"\0" * (17 * 2**20), "has ended the connection"),
    ],
)
def test_an_answer_that_must_not_be_is_an_error_that_names_the_server(frame: object, message: str) -> None:
    with scripted_server(RESET, frame) as url, RemotePolicy(url) as policy:
        policy.reset([made_up_prompt(1)])
        with pytest.raises(ServerError, match=message) as error:
            policy.act([made_up_observation(1)])
        assert url in str(error.value)


def test_a_connection_lost_within_an_episode_is_an_error_and_the_next_reset_makes_a_new_one() -> None:
    with serve_in_thread(ForMany()) as url:
        policy = RemotePolicy(url)
        policy.reset([made_up_prompt(1)])
    with pytest.raises(ServerError, match=f"{url} has ended the connection"):
        policy.act([made_up_observation(1)])
    with pytest.raises(ServerError, match="no policy server answers"):
        policy.reset([made_up_prompt(2)])
    with pytest.raises(PolicyError, match="call reset"):
        policy.act([made_up_observation(1)])
    with serve_in_thread(ForMany(), port=port_of(url)):
        policy.reset([made_up_prompt(3)])
        assert told(policy.act([made_up_observation(4)])[0]) == (3, 4, 1)
        policy.close()


def test_at_the_same_address_other_limits_hold_and_another_policy_is_refused() -> None:
    about = {"policy": {"sha256": "one"}}
    with serve_in_thread(ForMany(), max_episodes=1, about=about) as url:
        policy = RemotePolicy(url)
    with serve_in_thread(ForMany(), port=port_of(url), max_episodes=2, about=about):
        policy.reset([made_up_prompt(1)] * 2)
    with serve_in_thread(ForMany(), port=port_of(url), about={"policy": {"sha256": "two"}}):
        with pytest.raises(ServerError, match="has ended the connection"):
            policy.act([made_up_observation(1)] * 2)
        with pytest.raises(ServerError, match="another policy than before"):
            policy.reset([made_up_prompt(1)])
        policy.close()


def test_a_server_that_falls_silent_is_given_up() -> None:
    with (
        scripted_server(RESET, lambda connection: connection.recv()) as url,
        RemotePolicy(url) as policy,
    ):
        policy.reset([made_up_prompt(1)])
        shorten(policy, 0.1)
        with pytest.raises(ServerError, match="has not answered in time"):
            policy.act([made_up_observation(1)])


def test_a_server_that_is_silent_before_the_handshake_is_named_with_the_time() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"ws://127.0.0.1:{listening.getsockname()[1]}"
        with pytest.raises(ServerError, match=rf"{url} \(timed out"):
            RemotePolicy(url, timeout_s=0.2)


HOSTILE = "\x1b]0;owned\x07\x1b[2J\r\n\u202e\x9b31m" + "y" * 5000


def assert_harmless(error: ServerError) -> None:
    """Nothing that moves a terminal's cursor, and little of what was sent."""
    assert str(error).isprintable() and str(error).count("y") <= 200 and len(str(error)) < 500


def test_what_a_hostile_server_says_is_cut_and_cleaned() -> None:
    for frames in (
        [HOSTILE],
        [RESET, HOSTILE],
        [RESET, {"type": "act", HOSTILE: 1}],
        [RESET, {"type": HOSTILE}],
    ):
        with scripted_server(*frames) as url, RemotePolicy(url) as policy:
            with pytest.raises(ServerError) as error:
                policy.reset([made_up_prompt(1)])
                policy.act([made_up_observation(1)])
            assert_harmless(error.value)
    for metadata in (HOSTILE, {"protocol": HOSTILE}, {HOSTILE: {1.5: b"bytes"}, "protocol": PROTOCOL}):
        with scripted_server(metadata=metadata) as url, pytest.raises(ServerError) as error:
            RemotePolicy(url)
        assert_harmless(error.value)


def test_batches_above_the_limits_are_refused() -> None:
    with serve_in_thread(Telltale(), max_episodes=2) as url, RemotePolicy(url) as policy:
        with pytest.raises(ServerError, match=r"3 prompts; at most 2 are allowed.*--max-episodes"):
            policy.reset([made_up_prompt(1)] * 3)
        policy.reset([made_up_prompt(1)])
        with pytest.raises(PolicyError, match="got 2 observations for 1 prompts"):
            policy.act([made_up_observation(1)] * 2)
    with (
        serve_in_thread(Telltale(), max_message_bytes=1024) as url,
        RemotePolicy(url) as policy,
        pytest.raises(ServerError, match="1009"),
    ):
        policy.reset([made_up_prompt(1)] * 9)


def test_near_ties_are_passed_on_where_the_server_tells_them() -> None:
    class Unsure(Telltale):
        near_ties = (np.True_,)

    with serve_in_thread(Unsure()) as url, RemotePolicy(url) as policy:
        policy.reset([made_up_prompt(1)])
        assert policy.near_ties == []
        policy.act([made_up_observation(1)])
        assert policy.near_ties == [True]
