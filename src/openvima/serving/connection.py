"""A client's connection to a policy server: the first frame, then questions and answers."""

import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from threading import Timer
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from openvima.errors import MessageError, ServerError, echo
from openvima.serving.config import is_loopback
from openvima.serving.packing import unpack
from openvima.serving.protocol import PROTOCOL, TOKEN_VARIABLE, check_address, check_protocol, type_of

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

    def ask(self, request: bytes, kind: str) -> dict[str, Any]:  # Any: what was sent
        """Send a request and wait for its answer.

        Args:
            request: A packed request.
            kind: Its type, which the answer must have, too.

        Raises:
            ServerError: The server is lost, refuses, or answers what it must not.
        """
        with self._closed_by_errors(f"has not answered within {self._timeout_s:g} s"):
            with self._limited():
                self._socket.send(request)
            data = self._socket.recv(timeout=self._timeout_s)
        if isinstance(data, str):  # a refusal; the connection stays as it is
            raise ServerError(f"{self.url} refuses: {echo(data)}")
        with self._closed_by_errors():
            answer = _map_in(data)
            if type_of(answer) != kind:
                raise MessageError(f"the answer to a {kind!r} has type {str(type_of(answer))[:40]!r}")
        return answer

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


def _map_in(data: bytes) -> dict[str, Any]:  # Any: what was sent
    message = unpack(data)
    if not isinstance(message, dict):
        raise MessageError(f"a {type(message).__name__} came where a map must be")
    return message
