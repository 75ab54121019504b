"""What a server says to its clients, and to whom it says nothing."""

import socket
from collections.abc import Iterator, Mapping, Sequence
from http.client import HTTPConnection
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from openvima import __version__
from openvima.env import TabletopEnv
from openvima.errors import ConfigError, MessageError, PolicyError, ServerError
from openvima.evaluation import score
from openvima.policies import RandomPolicy
from openvima.serving import PROTOCOL, RemotePolicy, serve, serve_in_thread
from openvima.serving.protocol import encode_observation, encode_prompt, pack, unpack
from openvima.serving.server import ServerConfig, check_can_listen, is_own_page
from served_policies import ForMany, Telltale, made_up_observation, made_up_prompt, scripted_server, told

SETTINGS = {"max_episodes": 3, "max_connections": 2, "max_message_bytes": 2**16}


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with serve_in_thread(ForMany(), **SETTINGS, about={"policy": {"name": "telltale"}}) as url:
        yield url


@pytest.fixture
def connection(url: str) -> Iterator[ClientConnection]:
    """A connection after its first frame."""
    with connect(url, compression=None, proxy=None) as connection:
        connection.recv()
        yield connection


def ask(connection: ClientConnection, message: object) -> Any:
    connection.send(message if isinstance(message, str | bytes) else pack(message))
    answer = connection.recv()
    return answer if isinstance(answer, str) else unpack(answer)


def reset_with(*numbers: int, **more: object) -> dict:
    prompts = [encode_prompt(made_up_prompt(number)) for number in numbers]
    return {"type": "reset", "prompts": prompts, **more}


def act_with(*numbers: int | None) -> dict:
    seen = [None if n is None else encode_observation(made_up_observation(n)) for n in numbers]
    return {"type": "act", "observations": seen}


def fetch(url: str, path: str) -> tuple[int, bytes]:
    client = HTTPConnection(urlsplit(url).netloc, timeout=10)
    try:
        client.request("GET", path)
        response = client.getresponse()
        return response.status, response.read()
    finally:
        client.close()


def test_the_first_frame_says_what_is_served(url: str) -> None:
    with connect(url, proxy=None) as connection:
        first = unpack(connection.recv())  # type: ignore[arg-type]
    assert first == {
        "protocol": PROTOCOL,
        "versions": {"openvima": __version__},
        "policy": {"name": "telltale"},
        "modalities": ["rgb", "segm"],
        "control": "primitives",
    }


def test_a_batch_is_reset_and_acts(connection: ClientConnection) -> None:
    assert ask(connection, reset_with(5, 6)) == {"type": "reset"}
    answer = ask(connection, act_with(7, 8))
    assert [told(action) for action in answer["actions"]] == [(5, 7, 1), (6, 8, 1)]
    answer = ask(connection, act_with(None, 9))
    assert answer["actions"][0] is None and told(answer["actions"][1]) == (6, 9, 2)
    assert answer.keys() == {"type", "actions"} and answer["type"] == "act"


def test_single_observations_are_answered_with_the_bare_action(connection: ClientConnection) -> None:
    first = {**encode_observation(made_up_observation(3)), "prompt": encode_prompt(made_up_prompt(2))}
    assert told(ask(connection, first)) == (2, 3, 1)
    assert told(ask(connection, made_up_observation(4) | {"ee": np.int64(1)})) == (2, 4, 2)
    assert told(ask(connection, first)) == (2, 3, 1)


@pytest.mark.parametrize(
    ("request_", "refusal"),
    [
        (act_with(1), "no episodes yet"),
        (made_up_observation(1), "no episodes yet"),
        (reset_with(), "no prompts"),
        (reset_with(1, 2, 3, 4), "4 prompts; at most 3 are allowed"),
        (reset_with(1, hint="easy"), "'hint', which nobody knows"),
        ({"type": "reset", "prompts": [3]}, "prompt 0 is 3; it must be a map"),
        ({"type": "reset"}, "lacks 'prompts'"),
        ({"type": "dance"}, "type of the request is 'dance'; allowed: reset, act"),
        ({"type": np.zeros(2)}, "type of the request is a ndarray"),
        ({"prompt": 3}, "lacks 'rgb'"),
        ([1, 2], "the request is a list; it must be a map"),
        ("a text frame", "binary frames"),
        (b"\xc1", "no whole MessagePack"),
    ],
)
def test_a_bad_request_is_refused_with_a_reason_and_the_next_is_answered(
    connection: ClientConnection, request_: object, refusal: str
) -> None:
    answer = ask(connection, request_)
    assert isinstance(answer, str) and refusal in answer and "Traceback" not in answer
    assert ask(connection, reset_with(1)) == {"type": "reset"}


def test_acting_with_another_number_of_observations_is_refused(connection: ClientConnection) -> None:
    ask(connection, reset_with(1, 2))
    assert "1 observations for 2 prompts" in ask(connection, act_with(1))
    assert len(ask(connection, act_with(1, 2))["actions"]) == 2


def test_a_reset_that_was_refused_ends_no_episode(connection: ClientConnection) -> None:
    ask(connection, reset_with(1))
    assert isinstance(ask(connection, reset_with(1, 2, 3, 4)), str)
    assert told(ask(connection, act_with(5))["actions"][0]) == (1, 5, 1)


def test_a_message_above_the_limit_ends_the_connection_with_a_reason(connection: ClientConnection) -> None:
    connection.send(b"\0" * (2**16 + 1))
    with pytest.raises(ConnectionClosed) as closed:
        connection.recv()
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009


def test_more_clients_than_allowed_are_told_so_and_let_in_later(url: str) -> None:
    with connect(url, proxy=None) as one, connect(url, proxy=None) as two:
        assert one.recv() == two.recv()
        with connect(url, proxy=None) as three:
            assert "has its 2 clients" in str(three.recv())
    with RemotePolicy(url) as policy:
        policy.reset([made_up_prompt(1)])


def test_a_policy_without_sessions_serves_one_client_at_a_time() -> None:
    with serve_in_thread(Telltale()) as url:
        with RemotePolicy(url) as one, connect(url, proxy=None) as two:
            assert "has its one client" in str(two.recv())
            one.reset([made_up_prompt(1)])
            assert told(one.act([made_up_observation(2)])[0]) == (1, 2, 1)
        with RemotePolicy(url) as later:
            later.reset([made_up_prompt(3)])


def test_health_is_answered_over_http(url: str) -> None:
    assert fetch(url, "/healthz") == (200, b"OK\n")


def test_who_does_not_know_the_token_is_turned_away() -> None:
    with serve_in_thread(Telltale(), **SETTINGS, token="secret") as url:
        for header in (None, "Bearer", "Bearer ", "Bearer wrong", "secret", "Bearer secret2"):
            headers = {"Authorization": header} if header else None
            with (
                pytest.raises(InvalidStatus, match="401"),
                connect(url, additional_headers=headers, proxy=None),
            ):
                pass
        assert fetch(url, "/healthz") == (200, b"OK\n")
        for scheme in ("Bearer", "Api-Key"):
            headers = {"Authorization": f"{scheme} secret"}
            with connect(url, additional_headers=headers, proxy=None) as connection:
                assert unpack(connection.recv())["protocol"] == PROTOCOL  # type: ignore[arg-type]


def test_a_policy_that_fails_costs_an_answer_but_no_traceback_or_client() -> None:
    class Failing(Telltale):
        def act(self, observations):
            if observations[0]["ee"] == 0:
                raise KeyError("inner\nworkings")
            if observations[0]["ee"] == 2:
                return super().act(observations) * 2
            if observations[0]["ee"] == 3:
                return [{"pose0_position": np.array([None])}]
            return super().act(observations)

    with serve_in_thread(Failing()) as url, connect(url, proxy=None) as connection:
        connection.recv()
        ask(connection, reset_with(1))
        failed = ask(connection, made_up_observation(1) | {"ee": 0})
        assert "the policy failed: KeyError" in failed and "Traceback" not in failed
        assert "2 actions for 1 observations" in ask(connection, made_up_observation(1) | {"ee": 2})
        assert "dtype" in ask(connection, made_up_observation(1) | {"ee": 3})
        assert told(ask(connection, made_up_observation(1)))[:2] == (1, 1)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "", "192.168.0.7", "example.org", "localhost.example.org"])
def test_a_host_that_others_reach_needs_a_token(host: str) -> None:
    with pytest.raises(ConfigError, match="give a token"):
        ServerConfig(host=host)
    assert ServerConfig(host=host, token="secret").host == host


def test_settings_out_of_range_are_named_and_tokens_are_not_shown() -> None:
    with pytest.raises(ConfigError, match="max_episodes is 0; it must be a positive number"):
        ServerConfig(max_episodes=0)
    with pytest.raises(ConfigError, match=r"cannot listen on .*, port 70000"):
        serve(RandomPolicy(), port=70000)
    with pytest.raises(ConfigError, match="give a token"):
        ServerConfig(host="0.0.0.0", token="")
    assert "secret" not in repr(ServerConfig(token="secret"))
    with pytest.raises(PolicyError, match="the policy is a dict without reset and act"):
        serve({})


@pytest.mark.parametrize(
    ("host", "origin", "own"),
    [
        ("127.0.0.1:8000", "http://127.0.0.1:8000", True),
        ("localhost:8000", "http://localhost:8000", True),
        ("[::1]:8000", "http://[::1]:8000", True),
        ("127.0.0.1:8000", None, True),  # no browser
        ("127.0.0.1:8000", "https://elsewhere.org", False),
        ("127.0.0.1:8000", "http://127.0.0.1:9000", False),  # a page of another server here
        ("elsewhere.org:8000", "http://elsewhere.org:8000", False),  # a name that was given this address
    ],
)
def test_only_pages_of_the_server_itself_may_use_it(host: str, origin: str | None, own: bool) -> None:
    headers = {"Host": host} if origin is None else {"Host": host, "Origin": origin}
    assert is_own_page(headers) == own


def test_a_taken_port_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"cannot listen on 127.0.0.1, port {port}"):
            check_can_listen("127.0.0.1", port)
    check_can_listen("127.0.0.1", 0)


class WithJoints(RandomPolicy):
    """Keeps what it sees first."""

    modalities = ("rgb", "joints")
    seen: Sequence[Mapping] = ()

    def new_session(self) -> "WithJoints":
        return self

    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        self.seen = self.seen or [one for one in observations if one is not None]
        return super().act(observations)


def test_joints_are_sent_to_a_policy_that_asks_for_them_and_segmentation_is_not() -> None:
    policy = WithJoints()
    with serve_in_thread(policy) as url, RemotePolicy(url) as remote:
        assert remote.metadata["modalities"] == ["rgb", "joints"]
        score({"remote": remote}, tasks=("rotate",), levels=("L1",), episodes=1)
    assert set(policy.seen[0]) == {"rgb", "joints", "ee"}
    env = TabletopEnv("rotate", level="L1", domain="eval", modalities=("joints",))
    assert np.array_equal(policy.seen[0]["joints"], env.reset(seed=0)[0]["joints"])


@pytest.mark.parametrize("asked", ["rgb", ["depth", "rgb"], ["segm"], 3, [["rgb"]]])
def test_a_server_that_asks_for_what_is_not_sent_is_refused(asked: object) -> None:
    first = {"protocol": PROTOCOL, "modalities": asked}
    with scripted_server(metadata=first) as url, pytest.raises(ServerError, match="has modalities"):
        RemotePolicy(url)


def test_a_policy_that_asks_for_depth_cannot_be_served() -> None:
    policy = RandomPolicy()
    policy.modalities = ("rgb", "depth")  # type: ignore[attr-defined]
    with pytest.raises(MessageError, match="if asked, segm and joints"), serve_in_thread(policy):
        pass
