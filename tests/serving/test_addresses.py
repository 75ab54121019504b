"""Addresses of servers, and what their observations hold."""

import socket
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from openvima.env import TabletopEnv
from openvima.errors import ConfigError, MessageError, ServerError
from openvima.evaluation import score
from openvima.policies import RandomPolicy
from openvima.serving import RemotePolicy, serve_in_thread
from openvima.serving.protocol import decode_observation, encode_observation
from openvima.serving.server import check_can_listen, is_own_page
from served_policies import made_up_observation, scripted_server


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
    """Keeps what it sees."""

    modalities = ("rgb", "joints")
    seen: list[Mapping]

    def new_session(self) -> "WithJoints":
        return self

    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        self.seen = [one for one in observations if one is not None]
        return super().act(observations)


def test_joints_are_sent_to_a_policy_that_asks_for_them_and_segmentation_is_not() -> None:
    policy = WithJoints()
    with serve_in_thread(policy) as url, RemotePolicy(url) as remote:
        assert remote.record()["modalities"] == ["rgb", "joints"]
        score({"remote": remote}, tasks=("rotate",), levels=("L1",), episodes=1)
    assert set(policy.seen[0]) == {"rgb", "joints", "ee"}
    env = TabletopEnv("rotate", level="L1", domain="eval", modalities=("joints",))
    assert policy.seen[0]["joints"].shape == env.reset(seed=0)[0]["joints"].shape


def test_joints_pass_unchanged() -> None:
    sent = {**made_up_observation(1), "joints": np.arange(6, dtype=np.float32)}
    assert decode_observation(encode_observation(sent)) == sent


@pytest.mark.parametrize("asked", ["rgb", ["depth", "rgb"], ["segm"], 3, [["rgb"]]])
def test_a_server_that_asks_for_what_is_not_sent_is_refused(asked: object) -> None:
    from openvima.serving import PROTOCOL

    first = {"protocol": PROTOCOL, "modalities": asked}
    with scripted_server(metadata=first) as url, pytest.raises(ServerError, match="has modalities"):
        RemotePolicy(url)


def test_a_policy_that_asks_for_depth_cannot_be_served() -> None:
    policy = RandomPolicy()
    policy.modalities = ("rgb", "depth")  # type: ignore[attr-defined]
    with pytest.raises(MessageError, match="if asked, segm and joints"), serve_in_thread(policy):
        pass
