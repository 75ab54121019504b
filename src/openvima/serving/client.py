"""The client: a policy that asks a server what to do."""

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np

from openvima.errors import ConfigError, MessageError, PolicyError, ServerError
from openvima.policies.base import Policy
from openvima.scene import RenderedPrompt
from openvima.serving.config import is_loopback
from openvima.serving.packing import pack, require_extra, unpack
from openvima.serving.protocol import (
    PROTOCOL,
    TOKEN_VARIABLE,
    check_protocol,
    check_token,
    decode_action,
    encode_observation,
    encode_prompt,
    is_remote,
    read_request,
    type_of,
)

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

CONNECT_S = 10.0
CLOSE_S = 2.0
MAX_REPLY_BYTES = 16 * 2**20  # actions are small
_SHOWN = 1000  # characters of a server's error that are passed on


class RemotePolicy(Policy):
    """A policy behind a WebSocket; it may be written in any language.

    It connects at once and keeps the connection, in which the server keeps the episodes. A connection that
    was lost is made anew by `reset`, and only there: what the server knew of the running episodes is gone.

    Args:
        url: Address of the server, such as "ws://127.0.0.1:8000", or "wss://…" for an encrypted connection.
        token: For servers that want one; by default that of the environment variable OPENVIMA_SERVE_TOKEN.
        timeout_s: Seconds to wait for an answer.

    Raises:
        ConfigError: The address or the token cannot be one.
        ServerError: No server answers there, it wants another token, or it speaks another protocol.
        MissingExtraError: A package of the extra `serve` is missing.

    Example: `RemotePolicy("ws://127.0.0.1:8000")`, with `openvima serve` on the other side.
    """

    def __init__(self, url: str, *, token: str | None = None, timeout_s: float = 300.0) -> None:
        require_extra()
        self._connection: ClientConnection | None = None
        self.url = _checked_url(url)
        self._token = token or os.environ.get(TOKEN_VARIABLE) or None
        check_token(self._token)
        self._timeout_s = timeout_s
        self._num_episodes = 0
        self._connection, self.metadata = self._connect()

    def __enter__(self) -> "RemotePolicy":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __del__(self) -> None:
        if getattr(self, "_connection", None) is not None:
            with suppress(Exception):  # at the end of the program parts of it are gone
                self.close()

    def record(self) -> dict[str, Any]:  # Any: plain values
        """What the policy is, for results: all that the server says about it, apart from its limits."""
        return {key: value for key, value in self.metadata.items() if key != "limits"}

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Begin a batch of episodes.

        Raises:
            PolicyError: The batch is larger than the server allows.
            ServerError: The server is lost, or refuses; or there is another policy at its address now.
        """
        from websockets.protocol import State

        most = self._limit("episodes")
        if most is not None and len(prompts) > most:
            raise PolicyError(
                f"{self.url} takes at most {most} episodes at once, got {len(prompts)}; lower --batch, or "
                "serve with a higher --max-episodes."
            )
        self._num_episodes = 0
        images = [encode_prompt(prompt) for prompt in prompts]
        request = self._packed({"type": "reset", "protocol": PROTOCOL, "prompts": images}, "prompts")
        if self._connection is None or self._connection.state is not State.OPEN:
            self._reconnect()
        answer = self._ask(request, "reset")
        if answer.get("episodes", len(prompts)) != len(prompts):
            raise self._broken(f"it began {answer['episodes']!r} episodes instead of {len(prompts)}")
        self._num_episodes = len(prompts)

    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        """Ask the server for the next action of every episode.

        Raises:
            PolicyError: `reset` was not called, or with another number of prompts.
            ServerError: The server was lost, refuses, or gives no proper answer.
        """
        if not self._num_episodes or len(observations) != self._num_episodes:
            raise PolicyError(
                f"got {len(observations)} observations for {self._num_episodes} prompts; call reset with one "
                "for each episode first."
            )
        seen = [encode_observation(observation) for observation in observations]
        answer = self._ask(self._packed({"type": "act", "observations": seen}, "observations"), "act")
        try:
            listed = read_request(answer, "act", "actions", len(seen))
            actions = [decode_action(action, f"action {number}") for number, action in enumerate(listed)]
        except MessageError as error:
            raise self._broken(str(error)) from error
        if len(actions) != len(seen):
            raise self._broken(f"it gave {len(actions)} actions for {len(seen)} observations")
        return actions

    def close(self) -> None:
        """Say goodbye to the server."""
        connection, self._connection = self._connection, None
        self._num_episodes = 0
        if connection is not None:
            connection.close()

    def _connect(self) -> "tuple[ClientConnection, dict[str, Any]]":
        from websockets.exceptions import InvalidStatus, WebSocketException
        from websockets.sync.client import connect

        host = urlsplit(self.url).hostname or ""
        try:
            connection = connect(
                self.url,
                compression=None,
                max_size=MAX_REPLY_BYTES,
                open_timeout=CONNECT_S,
                close_timeout=CLOSE_S,
                ping_interval=None,  # a server may compute for longer than a ping may take
                proxy=None if is_loopback(host) else True,
                additional_headers={"Authorization": f"Bearer {self._token}"} if self._token else None,
            )
        except InvalidStatus as error:
            said = (error.response.body or b"").decode(errors="replace").strip()
            raise ServerError(
                f"{self.url} refuses the connection (HTTP {error.response.status_code}: {said[:_SHOWN]}); a "
                f"token can be given in the environment variable {TOKEN_VARIABLE}."
            ) from None
        except (OSError, WebSocketException) as error:
            raise ServerError(
                f"no policy server answers at {self.url} ({error or type(error).__name__}); start one with: "
                "openvima serve RUN"
            ) from error
        try:
            return connection, self._read_metadata(connection)
        except BaseException:
            connection.close()
            raise

    def _read_metadata(self, connection: "ClientConnection") -> dict[str, Any]:
        """Read the first frame: what is served, and in which protocol."""
        metadata = self._receive(connection, CONNECT_S)
        try:
            check_protocol(metadata.get("protocol"), theirs=self.url, ours="this client")
            json.dumps(metadata)
        except MessageError as error:
            raise ServerError(str(error)) from None
        except (TypeError, ValueError, RecursionError) as error:
            raise ServerError(
                f"{self.url} describes its policy with other than plain values: {error}"
            ) from None
        return metadata

    def _reconnect(self) -> None:
        self.close()
        connection, metadata = self._connect()
        self._connection = connection
        if metadata != self.metadata:
            self.close()
            raise ServerError(f"{self.url} serves another policy than before; begin a new evaluation.")

    def _packed(self, message: Mapping[str, Any], what: str) -> bytes:
        request = pack(message)
        most = self._limit("message_bytes")
        if most is not None and len(request) > most:
            raise PolicyError(
                f"the {what} take {len(request):,} bytes, {self.url} allows {most:,}; lower --batch, or "
                "serve with a higher --max-message-mb."
            )
        return request

    def _limit(self, name: str) -> int | None:
        limits = self.metadata.get("limits")
        most = limits.get(name) if isinstance(limits, dict) else None
        return most if isinstance(most, int) else None

    def _ask(self, request: bytes, kind: str) -> dict[str, Any]:
        """Send a request and wait for its answer."""
        from websockets.exceptions import ConnectionClosed

        if self._connection is None:
            raise PolicyError(f"the connection to {self.url} was lost; call reset to begin anew.")
        try:
            self._connection.send(request)
        except ConnectionClosed as error:
            raise self._lost(f"ended the connection ({error})") from error
        except BaseException:
            self.close()
            raise
        answer = self._receive(self._connection, self._timeout_s)
        if type_of(answer) != kind:
            raise self._broken(
                f"it answers a request of type {kind!r} with one of {type_of(answer)!r}"[:_SHOWN]
            )
        return answer

    def _receive(self, connection: "ClientConnection", timeout_s: float) -> dict[str, Any]:
        """Wait for a map; a text is the server's way to say why it gives none."""
        from websockets.exceptions import ConnectionClosed

        try:
            data = connection.recv(timeout=timeout_s)
        except ConnectionClosed as error:
            raise self._lost(f"ended the connection ({error})") from error
        except TimeoutError as error:
            raise self._lost(f"has not answered within {timeout_s:g} s") from error
        except BaseException:  # an answer that comes later would be taken for that to the next request
            self.close()
            raise
        if isinstance(data, str):
            raise ServerError(f"{self.url} refuses: {data[:_SHOWN]}")
        try:
            answer = unpack(data)
        except MessageError as error:
            raise self._broken(str(error)) from error
        if not isinstance(answer, dict):
            raise self._broken(f"it sent a {type(answer).__name__} instead of a map")
        return answer

    def _lost(self, how: str) -> ServerError:
        lost = "; the episodes that it played are lost." if self._num_episodes else "."
        self.close()
        return ServerError(f"the policy server at {self.url} {how}{lost}")

    def _broken(self, what: str) -> ServerError:
        self.close()
        return ServerError(f"{self.url} does not keep to {PROTOCOL}: {what}.")


def describe(url: str) -> dict[str, Any]:  # Any: plain values
    """Ask a server what it serves; see `RemotePolicy` for the errors."""
    with RemotePolicy(url) as policy:
        return policy.record()


def _checked_url(url: str) -> str:
    try:
        parts = urlsplit(url)
        usable = is_remote(url) and bool(parts.hostname) and parts.port != 0 and not parts.fragment
    except ValueError:  # the port is no number
        usable = False
    if not usable:
        raise ConfigError(f"the address of a policy server is {url!r}; it must be ws://HOST:PORT or wss://….")
    return url
