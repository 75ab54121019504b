"""The client: a policy that asks a server what to do, over a connection of questions and answers."""

import json
import os
import re
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from threading import Timer
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from openvima.errors import MessageError, PolicyError, PolicyRaisedError, ServerError, echo
from openvima.policies.base import Policy
from openvima.scene import RenderedPrompt
from openvima.scene.action import PRIMITIVES
from openvima.serving.protocol import (
    DEFAULT_MODALITIES,
    POLICY_FAILED,
    PROTOCOL,
    TOKEN_VARIABLE,
    check_address,
    check_control,
    check_modalities,
    check_protocol,
    check_token,
    decode_action,
    encode_observation,
    encode_prompt,
    is_loopback,
    pack,
    read_list,
    require_extra,
    type_of,
    unpack,
)

if TYPE_CHECKING:
    from websockets.sync.connection import Connection as Socket

CONNECT_S = 10.0
CLOSE_S = 2.0
MAX_REPLY_BYTES = 16 * 2**20  # actions are small
MAX_METADATA_BYTES = 2**16  # all of it gets into results


class Connection:
    """A connection that is open; whatever goes wrong in it, apart from a refusal, closes it for good.

    Args:
        url: Address of the server.
        token: For servers that want one.
        timeout_s: Seconds to wait for an answer.

    Raises:
        ConfigError: The address cannot be one.
        ServerError: No server answers there, it turns this client away, or it speaks another protocol.
    """

    def __init__(self, url: str, token: str | None, timeout_s: float) -> None:
        check_address(url)
        self.url = url
        self._timeout_s = timeout_s
        self._open = ExitStack()  # the library gives connections as context managers
        self._socket = self._open.enter_context(_opened(url, token, min(CONNECT_S, timeout_s)))
        greet_s = min(CONNECT_S, timeout_s)
        with self._closed_by_errors(f"sent no first frame within {greet_s:g} s after the handshake"):
            self.metadata = self._read_metadata(greet_s)

    @property
    def is_open(self) -> bool:
        """Whether nothing has been heard of an end, such as that of a server that was stopped."""
        from websockets.protocol import State

        return self._socket.state is State.OPEN

    def ask(self, request: bytes, kind: str) -> dict[str, Any]:
        """Send a request and wait for its answer.

        Args:
            request: A packed request.
            kind: Its type, which the answer must have, too.

        Raises:
            ServerError: The server is lost, refuses, or answers what it must not.
            PolicyError: The policy refuses, or raised.
        """
        with self._closed_by_errors(f"has not answered within {self._timeout_s:g} s"):
            with self._limited():
                self._socket.send(request)
            data = self._socket.recv(timeout=self._timeout_s)
        if isinstance(data, str):  # a refusal; the connection stays as it is
            raise self._refusal(data)
        with self._closed_by_errors():
            answer = _map_in(data)
            if type_of(answer) != kind:
                raise MessageError(f"the answer to a {kind!r} has type {str(type_of(answer))[:40]!r}")
        return answer

    def _refusal(self, text: str) -> ServerError | PolicyError:
        """Return the error for a refusal; that of a policy names no address, since results keep it."""
        if text.startswith(POLICY_FAILED):
            return PolicyRaisedError(f"the policy on the server raised {echo(text[len(POLICY_FAILED) :])}")
        if re.match(r"(Policy|Prompt|Detection|Shape|Action)Error: ", text):
            return PolicyError(f"the policy on the server refuses: {echo(text)}")
        return ServerError(f"{self.url} refuses: {echo(text)}")

    def broken(self, what: str) -> ServerError:
        """Close the connection, and return the error for an answer that must not be."""
        self.close()
        return ServerError(f"{self.url} does not keep to {PROTOCOL}: {echo(what)}")

    def close(self) -> None:
        """Say goodbye to the server."""
        self._open.close()

    def _read_metadata(self, timeout_s: float) -> dict[str, Any]:
        """Read the first frame: what is served, and in which protocol."""
        data = self._socket.recv(timeout=timeout_s)
        if isinstance(data, str):
            raise ServerError(f"{self.url} refuses: {echo(data)}")
        if len(data) > MAX_METADATA_BYTES:
            raise MessageError(f"its metadata has {len(data):,} bytes; {MAX_METADATA_BYTES:,} are allowed")
        metadata = _map_in(data)
        try:
            check_protocol(metadata.get("protocol"), theirs=self.url, ours="this client")
        except MessageError as error:
            raise ServerError(str(error)) from None
        try:
            json.dumps(metadata, allow_nan=False)  # it gets into results.json
        except (TypeError, ValueError, RecursionError) as error:
            raise MessageError(f"its metadata holds other than plain, finite values ({error})") from None
        return metadata

    @contextmanager
    def _closed_by_errors(self, silence: str = "is silent") -> Iterator[None]:
        """Close the connection if the block fails: answers that come later would be taken for others.

        Args:
            silence: What the error says of a server that sends nothing.
        """
        from websockets.exceptions import ConnectionClosed

        try:
            yield
        except MessageError as error:
            raise self.broken(str(error)) from error
        except ConnectionClosed as error:
            self.close()
            raise ServerError(
                f"the policy server at {self.url} has ended the connection ({echo(str(error))})."
            ) from error
        except TimeoutError as error:
            self.close()
            raise ServerError(f"the policy server at {self.url} {silence}.") from error
        except BaseException:
            self.close()
            raise

    @contextmanager
    def _limited(self) -> Iterator[None]:
        """Break the connection if the block takes too long, such as that of a server that does not read."""

        def stop() -> None:
            with suppress(OSError):  # it may be closed by now
                self._socket.socket.shutdown(socket.SHUT_RDWR)

        timer = Timer(self._timeout_s, stop)
        timer.start()
        try:
            yield
        finally:
            timer.cancel()


@contextmanager
def _opened(url: str, token: str | None, timeout_s: float) -> "Iterator[Socket]":
    from websockets.exceptions import InvalidStatus, WebSocketException
    from websockets.sync.client import connect

    with ExitStack() as stack:
        try:
            opening = connect(
                url,
                compression=None,
                max_size=MAX_REPLY_BYTES,
                open_timeout=timeout_s,
                close_timeout=CLOSE_S,
                ping_interval=None,  # a server may compute for longer than a ping may take
                proxy=None if is_loopback(urlsplit(url).hostname or "") else True,
                additional_headers={"Authorization": f"Bearer {token}"} if token else None,
            )
            connection = stack.enter_context(opening)
        except InvalidStatus as error:
            said = (error.response.body or b"").decode(errors="replace").strip()
            raise ServerError(
                f"{url} refuses the connection (HTTP {error.response.status_code}: {echo(said)}); a token "
                f"can be given in the environment variable {TOKEN_VARIABLE}."
            ) from None
        except TimeoutError as error:
            raise ServerError(
                f"no policy server answers at {url}: no handshake within {timeout_s:g} s; start one with: "
                "openvima serve RUN"
            ) from error
        except (OSError, WebSocketException) as error:
            reason = echo(str(error)) or type(error).__name__
            raise ServerError(
                f"no policy server answers at {url} ({reason}); start one with: openvima serve RUN"
            ) from error
        yield connection


def _map_in(data: bytes) -> dict[str, Any]:
    message = unpack(data)
    if not isinstance(message, dict):
        raise MessageError(f"a {type(message).__name__} came where a map must be")
    return message


TIMEOUT_S = 300.0


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

    _connection: Connection | None = None

    def __init__(self, url: str, *, token: str | None = None, timeout_s: float = TIMEOUT_S) -> None:
        require_extra()
        self.url = url
        self._token = token or os.environ.get(TOKEN_VARIABLE) or None
        check_token(self._token)
        self._timeout_s = timeout_s
        self._num_episodes = 0
        self.near_ties: list[bool] = []  # see `NetworkPolicy.near_ties`; empty where the server does not say
        self._connection = Connection(url, self._token, timeout_s)
        self.metadata = self._connection.metadata
        try:
            self.modalities = check_modalities(
                self.metadata.get("modalities", DEFAULT_MODALITIES), "the policy"
            )
            self.control = check_control(self.metadata.get("control", PRIMITIVES), "the policy")
        except MessageError as error:
            raise self._connection.broken(str(error)) from error

    def __enter__(self) -> "RemotePolicy":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __del__(self) -> None:
        with suppress(Exception):  # at the end of the program parts of it are gone
            self.close()

    def record(self) -> dict[str, Any]:
        """What the policy is, for results: all that the server says about it, apart from its limits."""
        return _without_limits(self.metadata)

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Begin a batch of episodes.

        Raises:
            PolicyError: The batch is larger than the server allows.
            ServerError: The server is lost, or refuses; or there is another policy at its address now.
        """
        self._num_episodes, self.near_ties = 0, []
        connection = self._connected()
        most = self._limit("episodes")
        if most is not None and len(prompts) > most:
            raise PolicyError(
                f"{self.url} takes at most {most} episodes at once, got {len(prompts)}; lower --batch, or "
                "serve with a higher --max-episodes."
            )
        sent = [encode_prompt(prompt) for prompt in prompts]
        request = self._packed({"type": "reset", "protocol": PROTOCOL, "prompts": sent}, "prompts")
        connection.ask(request, "reset")
        self._num_episodes = len(prompts)

    def act(self, observations: Sequence[Mapping | None]) -> list[Any]:
        """Ask the server for the next action of every episode.

        Raises:
            PolicyError: `reset` was not called, or with another number of prompts.
            ServerError: The server was lost, refuses, or gives no proper answer.
        """
        count = self._num_episodes
        if not count or len(observations) != count:
            raise PolicyError(
                f"got {len(observations)} observations for {count} prompts; call reset with one for each "
                "episode first."
            )
        assert self._connection is not None  # reset made it
        seen = [encode_observation(observation) for observation in observations]
        request = self._packed({"type": "act", "observations": seen}, "observations")
        answer = self._connection.ask(request, "act")
        try:
            listed = read_list(answer, "act", "actions", count, optional=("near_ties",))
            actions = [
                decode_action(action, f"action {number}", control=self.control)
                for number, action in enumerate(listed)
            ]
            near_ties = answer.get("near_ties", [])
            if len(actions) != count or not isinstance(near_ties, list) or len(near_ties) not in (0, count):
                raise MessageError(f"actions, and near_ties if any, must be {count}, as the observations")
        except MessageError as error:
            raise self._connection.broken(str(error)) from error
        self.near_ties = [near is True for near in near_ties]
        return actions

    def close(self) -> None:
        """Say goodbye to the server."""
        if self._connection is not None:
            self._connection.close()

    def _connected(self) -> Connection:
        """Return the connection, or a new one to the same policy."""
        assert self._connection is not None
        if not self._connection.is_open:
            before = self.record()
            self._connection = Connection(self.url, self._token, self._timeout_s)
            if _without_limits(self._connection.metadata) != before:
                self._connection.close()
                raise ServerError(f"{self.url} serves another policy than before; begin a new evaluation.")
            self.metadata = self._connection.metadata  # its limits may be new
        return self._connection

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


def _without_limits(metadata: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in metadata.items() if key != "limits"}


def describe(url: str) -> dict[str, Any]:
    """Ask a server what it serves; see `RemotePolicy` for the errors."""
    with RemotePolicy(url) as policy:
        return policy.record()
