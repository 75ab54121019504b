"""Which pages may use a server on this machine, and which addresses a server can take."""

import socket

import pytest

from openvima.errors import ConfigError
from openvima.serving.server import check_can_listen, is_own_page


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
    assert is_own_page(headers, any_host=False) == own


def test_servers_with_a_token_have_any_name_but_no_pages_of_others() -> None:
    headers = {"Host": "lab.example.org", "Origin": "http://lab.example.org"}
    assert is_own_page(headers, any_host=True)
    assert not is_own_page({**headers, "Origin": "http://elsewhere.org"}, any_host=True)


def test_a_taken_port_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"cannot listen on 127.0.0.1, port {port}"):
            check_can_listen("127.0.0.1", port)
    check_can_listen("127.0.0.1", 0)
