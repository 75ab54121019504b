"""Settings of a policy server."""

import ipaddress
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any
from urllib.parse import urlsplit

from openvima.errors import ConfigError, unknown_name
from openvima.serving.packing import MAX_LENGTH
from openvima.serving.protocol import TOKEN_VARIABLE, check_token
from openvima.tasks.prompts import check_prompts


@dataclass(frozen=True, slots=True)
class ServerConfig:
    """Where a policy is served, and what its clients may ask for.

    Args:
        host: Interface to listen on. Any but the loopback interface needs a token.
        port: TCP port; 0 takes a free one.
        token: Clients must know it. None lets in everyone who reaches the port.
        max_message_bytes: Size of the largest message. A prompt image takes 0.26 MB, and so does an
            observation.
        max_episodes: Episodes of the largest batch, for which 128 MiB are enough.
        max_connections: Clients at the same time.
        max_batch: Episodes of several clients that a network computes at once; with 1 it answers one request
            after the other.
        idle_s: Seconds after which a client is dropped that has not sent a whole message, or not taken an
            answer.
        num_threads: Threads that a network computes with. One gives the last bits of `openvima evaluate`.
        prompts: "multimodal": prompts as clients send them. "text" or "mixed": with descriptions in place of
            object images, see `openvima.make`; a policy that reads language alone serves every client.

    Raises:
        ConfigError: A setting is out of its range, there is no such form of prompts, or the server would be
            open to others without a token.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    token: str | None = field(default=None, repr=False)
    max_message_bytes: int = 128 * 2**20
    max_episodes: int = 64
    max_connections: int = 16
    max_batch: int = 16
    idle_s: float = 600.0
    num_threads: int = 1
    prompts: str = "multimodal"

    def __post_init__(self) -> None:
        problems = [
            f"{name} is {value:g}; it must lie within {least:,} and {most:,}."
            for name, value, least, most in (
                ("port", self.port, 0, 65535),
                ("max_message_bytes", self.max_message_bytes, 1024, 2**32),
                ("max_episodes", self.max_episodes, 1, MAX_LENGTH),
                ("max_batch", self.max_batch, 1, 1024),
                ("max_connections", self.max_connections, 1, 10_000),
                ("idle_s", self.idle_s, 0.01, 10**6),
                ("num_threads", self.num_threads, 1, 1024),
            )
            if not least <= value <= most
        ]
        if self.token is None and not is_loopback(self.host):
            problems.append(
                f"host is {self.host!r}, which other machines may reach; give a token with --token or "
                f"{TOKEN_VARIABLE}, or serve on 127.0.0.1 and let clients in through `ssh -L`."
            )
        if problems:
            raise ConfigError(" ".join(problems))
        check_token(self.token)
        check_prompts(self.prompts)


def server_config(**settings: Any) -> ServerConfig:  # Any: of several kinds
    """Return the config with these fields.

    Raises:
        ConfigError: There is no such field, or as for `ServerConfig`.
    """
    known = [field.name for field in fields(ServerConfig)]
    if unknown := [name for name in settings if name not in known]:
        raise ConfigError(" ".join(unknown_name("setting of a server", name, known) for name in unknown))
    return ServerConfig(**settings)


def is_loopback(host: str) -> bool:
    """Whether a host name or address is certain to mean this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def is_own_page(headers: Mapping[str, str], *, any_host: bool) -> bool:
    """Whether a browser opens a WebSocket from a page of the same server.

    Pages of other sites could open one to the loopback interface, or give a name of theirs its address.

    Args:
        headers: Of the request.
        any_host: Whether the server may have names that do not mean this machine alone.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host:
        return False
    return any_host or is_loopback(urlsplit(f"//{host}").hostname or "")


def check_can_listen(host: str, port: int) -> None:
    """Check that an address can be listened on, for servers that would try other ports or wait for ever.

    Raises:
        ConfigError: It is taken, or not one of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host, port), family=family):
            pass
    except OSError as error:
        raise ConfigError(f"cannot listen on {host}, port {port}: {error}; choose another one.") from error
