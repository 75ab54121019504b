"""A client's connection to a policy server: the first frame, then questions and answers."""

import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from threading import Timer
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from openvima.errors import ConfigError, MessageError, ServerError
from openvima.serving.config import is_loopback
from openvima.serving.packing import unpack
from openvima.serving.protocol import PROTOCOL, TOKEN_VARIABLE, check_protocol, is_remote, type_of

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

CONNECT_S = 10.0
CLOSE_S = 2.0
MAX_REPLY_BYTES = 16 * 2**20  # actions are small
_SHOWN = 1000  # characters of a server's error that are passed on


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
        self.url = _checked_url(url)
        self._timeout_s = timeout_s
        self._open = ExitStack()  # the library gives connections as context managers
        self._socket = self._open.enter_context(_opened(url, token))
        with self._closed_by_errors():
            self.metadata = self._read_metadata()

    @property
    def is_open(self) -> bool:
        """Whether nothing has been heard of an end, such as that of a server that was stopped."""
        from websockets.protocol import State

        return self._socket.state is State.OPEN

    def ask(self, request: bytes, kind: str) -> dict[str, Any]:  # Any: what was sent
        """Send a request and wait for its answer.

        Args:
            request: A packed request.
            kind: Its type, which the answer must have, too.

        Raises:
            ServerError: The server is lost, refuses, or answers what it must not.
        """
        with self._closed_by_errors():
            with self._limited():
                self._socket.send(request)
            data = self._socket.recv(timeout=self._timeout_s)
        if isinstance(data, str):  # a refusal; the connection stays as it is
            raise ServerError(f"{self.url} refuses: {data[:_SHOWN]}")
        with self._closed_by_errors():
            answer = _map_in(data)
            if type_of(answer) != kind:
                raise MessageError(f"the answer to a {kind!r} has type {str(type_of(answer))[:40]!r}")
        return answer

    def broken(self, what: str) -> ServerError:
        """Close the connection, and return the error for an answer that must not be."""
        self.close()
        return ServerError(f"{self.url} does not keep to {PROTOCOL}: {what}")

    def close(self) -> None:
        """Say goodbye to the server."""
        self._open.close()

    def _read_metadata(self) -> dict[str, Any]:
        """Read the first frame: what is served, and in which protocol."""
        data = self._socket.recv(timeout=min(CONNECT_S, self._timeout_s))
        if isinstance(data, str):
            raise ServerError(f"{self.url} refuses: {data[:_SHOWN]}")
        metadata = _map_in(data)
        try:
            check_protocol(metadata.get("protocol"), theirs=self.url, ours="this client")
        except MessageError as error:
            raise ServerError(str(error)) from None
        try:
            json.dumps(metadata)
        except (TypeError, ValueError, RecursionError) as error:
            raise MessageError(f"its metadata holds other than plain values ({error})") from None
        return metadata

    @contextmanager
    def _closed_by_errors(self) -> Iterator[None]:
        """Close the connection if the block fails: answers that come later would be taken for others."""
        from websockets.exceptions import ConnectionClosed

        try:
            yield
        except MessageError as error:
            raise self.broken(str(error)) from error
        except ConnectionClosed as error:
            self.close()
            raise ServerError(
                f"the policy server at {self.url} has ended the connection ({error})."
            ) from error
        except TimeoutError as error:
            self.close()
            raise ServerError(
                f"the policy server at {self.url} has not answered within {self._timeout_s:g} s."
            ) from error
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
def _opened(url: str, token: str | None) -> "Iterator[ClientConnection]":
    from websockets.exceptions import InvalidStatus, WebSocketException
    from websockets.sync.client import connect

    with ExitStack() as stack:
        try:
            opening = connect(
                url,
                compression=None,
                max_size=MAX_REPLY_BYTES,
                open_timeout=CONNECT_S,
                close_timeout=CLOSE_S,
                ping_interval=None,  # a server may compute for longer than a ping may take
                proxy=None if is_loopback(urlsplit(url).hostname or "") else True,
                additional_headers={"Authorization": f"Bearer {token}"} if token else None,
            )
            connection = stack.enter_context(opening)
        except InvalidStatus as error:
            said = (error.response.body or b"").decode(errors="replace").strip()
            raise ServerError(
                f"{url} refuses the connection (HTTP {error.response.status_code}: {said[:_SHOWN]}); a token "
                f"can be given in the environment variable {TOKEN_VARIABLE}."
            ) from None
        except (OSError, WebSocketException) as error:
            raise ServerError(
                f"no policy server answers at {url} ({error or type(error).__name__}); start one with: "
                "openvima serve RUN"
            ) from error
        yield connection


def _map_in(data: bytes) -> dict[str, Any]:  # Any: what was sent
    message = unpack(data)
    if not isinstance(message, dict):
        raise MessageError(f"a {type(message).__name__} came where a map must be")
    return message


def _checked_url(url: str) -> str:
    try:
        parts = urlsplit(url)
        usable = is_remote(url) and bool(parts.hostname) and parts.port != 0 and not parts.fragment
    except ValueError:  # the port is no number
        usable = False
    if not usable:
        raise ConfigError(f"the address of a policy server is {url!r}; it must be ws://HOST:PORT or wss://….")
    return url
