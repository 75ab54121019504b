"""The policy server: loads nothing itself, serves a policy that exists, to several clients at once."""

import asyncio
import hmac
import http
import logging
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from openvima import __version__
from openvima.errors import ConfigError, echo
from openvima.policies.base import Policy
from openvima.policies.own_code import checked_policy
from openvima.policies.prompt_limits import PromptLimits
from openvima.scene.command import PRIMITIVES
from openvima.serving.batching import DynamicBatcher
from openvima.serving.config import ServerConfig, server_config
from openvima.serving.packing import pack, require_extra
from openvima.serving.protocol import DEFAULT_MODALITIES, PROTOCOL, check_control, check_modalities
from openvima.serving.session import Session

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection
    from websockets.http11 import Request, Response

HEALTH_PATH = "/healthz"
MAX_FRAGMENTS = 1024  # of a message, besides one for each KiB: each costs time, and empty ones have no size
CLOSE_S = 2.0  # for the other side to say goodbye
_LOG = logging.getLogger(__name__)
_TRANSPORT_LOG = logging.getLogger(f"{__name__}.transport")
_TRANSPORT_LOG.setLevel(logging.CRITICAL)  # a traceback for every port scan; `serve_client` says what matters


def serve(
    policy: Policy,
    *,
    port: int = 8000,
    about: Mapping[str, Any] | None = None,  # Any: plain values
    ready: Callable[[str], None] | None = None,
    **settings: Any,  # Any: of several kinds
) -> None:
    """Serve a policy until Ctrl-C.

    Args:
        policy: Follows the `Policy` protocol. If it has a method `new_session`, which returns a policy with
            episodes of its own, each client gets one; else only one client is let in at a time.
        port: TCP port; 0 takes a free one.
        about: What the policy is, for clients and their results: its name, a hash of its weights. Results
            of an interrupted evaluation are kept for as long as this stays the same.
        ready: Called with the server's address once it answers.
        **settings: Other fields of `ServerConfig`, such as `host`, `token` or `max_connections`.

    Raises:
        ConfigError: A setting is unknown or out of range, the port is taken, or the host is not one of this
            machine.
        PolicyError: The policy lacks a method.
        MissingExtraError: A package of the extra `serve` is missing.
        KeyboardInterrupt: By Ctrl-C, after all connections were closed.
    """
    require_extra()
    server = _PolicyServer(policy, server_config(port=port, **settings), about or {})
    asyncio.run(server.run(ready or (lambda url: None), asyncio.Event()))


@contextmanager
def serve_in_thread(
    policy: Policy,
    *,
    port: int = 0,
    about: Mapping[str, Any] | None = None,  # Any: plain values
    **settings: Any,  # Any: of several kinds
) -> Iterator[str]:
    """Serve a policy in a thread of this process while the block runs.

    Args:
        policy: As for `serve`.
        port: As for `serve`; by default a free one.
        about: As for `serve`.
        **settings: As for `serve`.

    Yields:
        The server's address.

    Raises:
        ConfigError: As for `serve`.
        PolicyError: As for `serve`.
        MissingExtraError: As for `serve`.
    """
    require_extra()
    server = _PolicyServer(policy, server_config(port=port, **settings), about or {})
    url: Future[str] = Future()
    loop: Future[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def run() -> None:
        stop = asyncio.Event()
        loop.set_result((asyncio.get_running_loop(), stop))
        await server.run(url.set_result, stop)

    def work() -> None:
        try:
            asyncio.run(run())
        except BaseException as error:
            if url.done():
                raise
            url.set_exception(error)

    thread = threading.Thread(target=work, name="openvima-serve", daemon=True)
    thread.start()
    try:
        address = url.result()
    except BaseException:
        thread.join()
        raise
    try:
        yield address
    finally:
        running, stop = loop.result()
        running.call_soon_threadsafe(stop.set)
        thread.join()


class _PolicyServer:
    """A served policy.

    Connections share one event loop, in which nothing takes long. Requests are read and checked in threads of
    their own, and answered and packed in one other thread, so that policies need not be safe to use from
    several.
    """

    def __init__(self, policy: Policy, config: ServerConfig, about: Mapping[str, Any]) -> None:
        checked_policy(policy, "the policy is")
        self._config = config
        self._new_policy: Callable[[], Policy] = getattr(policy, "new_session", lambda: policy)
        self._max_connections = config.max_connections if hasattr(policy, "new_session") else 1
        self._num_connections = 0
        limits: PromptLimits = getattr(policy, "prompt_limits", PromptLimits())
        prompt_limits = {f"prompt_{name}": number for name, number in asdict(limits).items()}
        self._metadata = pack(
            {
                "protocol": PROTOCOL,
                "versions": {"openvima": __version__},
                **about,
                "modalities": check_modalities(
                    getattr(policy, "modalities", DEFAULT_MODALITIES), "the policy"
                ),
                "control": check_control(getattr(policy, "control", PRIMITIVES), "the policy"),
                "limits": {
                    "message_bytes": config.max_message_bytes,
                    "episodes": config.max_episodes,
                    "idle_s": config.idle_s,
                    **prompt_limits,
                },
            }
        )

    async def run(self, ready: Callable[[str], None], stop: asyncio.Event) -> None:
        """Serve until `stop` is set, or this is cancelled."""
        from websockets.asyncio.server import serve

        config = self._config
        threads = (config.num_threads,)
        with (
            ThreadPoolExecutor(2, "openvima-reading") as readers,
            ThreadPoolExecutor(1, "openvima-policy", _set_threads, threads) as computing,
        ):
            self._batcher = DynamicBatcher(readers, computing, config.max_batch)
            try:
                server = await serve(
                    self._serve_client,
                    config.host,
                    config.port,
                    process_request=self._admit,
                    origins=[None],  # browsers name one: no page that somebody looks at may use the server
                    compression=None,  # no message grows beyond the bytes that came in
                    max_size=config.max_message_bytes,
                    max_queue=1,
                    ping_timeout=max(60.0, config.idle_s / 10),  # clients that compile code do not answer
                    close_timeout=CLOSE_S,
                    logger=_TRANSPORT_LOG,
                )
            except (OSError, OverflowError) as error:
                raise ConfigError(
                    f"cannot listen on {config.host}, port {config.port}: {error}; choose another one."
                ) from error
            async with server:
                ready(_address(server))
                await stop.wait()

    def _admit(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        """Answer health checks, and turn away who does not know the token."""
        if request.path == HEALTH_PATH:
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        token = self._config.token
        if token is None:
            return None
        given = " ".join(request.headers.get_all("Authorization")).partition(" ")[2]  # scheme, then token
        if hmac.compare_digest(given.encode(errors="replace"), token.encode()):
            return None
        _LOG.warning("%s: wrong token, or none", _name(connection))
        return connection.respond(
            http.HTTPStatus.UNAUTHORIZED, "this server wants a token: Authorization: Bearer TOKEN\n"
        )

    async def _serve_client(self, connection: "ServerConnection") -> None:
        """Answer one client until it goes, or does nothing for too long."""
        from websockets.exceptions import ConnectionClosed
        from websockets.frames import CloseCode

        if self._num_connections >= self._max_connections:
            count = "one client" if self._max_connections == 1 else f"{self._max_connections} clients"
            text = f"this server has its {count} at the moment; try again later."
            _LOG.warning("%s: refused, the server is full", _name(connection))
            await connection.send(text)
            await connection.close(CloseCode.TRY_AGAIN_LATER, text)
            return
        self._num_connections += 1
        _LOG.info("%s: connected", _name(connection))
        try:
            await self._converse(connection)
        except TimeoutError:
            reason = f"no whole message within {self._config.idle_s:g} s"
            _LOG.warning("%s: dropped, %s", _name(connection), reason)
            await connection.close(CloseCode.POLICY_VIOLATION, reason)
        except ConnectionClosed as closed:
            _LOG.info("%s: gone (%s)", _name(connection), echo(str(closed)))
        finally:
            self._num_connections -= 1

    async def _converse(self, connection: "ServerConnection") -> None:
        session = Session(self._new_policy(), self._config.max_episodes, self._config.prompts)
        reply: bytes | str = self._metadata
        while True:
            async with asyncio.timeout(self._config.idle_s):
                await connection.send(reply)
                data = await _whole_message(connection)
            answer = await self._batcher.submit(session, data)
            del data  # it may be large, and the policy may be busy with others
            reply = answer if isinstance(answer, str) else await answer
            if isinstance(reply, str):
                _LOG.warning("%s: refused: %s", _name(connection), reply)


async def _whole_message(connection: "ServerConnection") -> bytes | str:
    """Receive a message of limited size and number of fragments."""
    from websockets.frames import CloseCode

    parts: list[Any] = []  # Any: all bytes or all texts
    allowed = float(MAX_FRAGMENTS)
    async for part in connection.recv_streaming():
        parts.append(part)
        allowed += len(part) / 1024
        if len(parts) > allowed:
            await connection.close(CloseCode.POLICY_VIOLATION, f"{len(parts):,} fragments of a short message")
    return type(parts[0])().join(parts)


def _set_threads(num_threads: int) -> None:
    """Runs in the thread that computes: torch keeps the number for each thread."""
    if (torch := sys.modules.get("torch")) is not None:  # else no policy can use it
        torch.set_num_threads(num_threads)


def _address(server: "Server") -> str:
    host, port = next(iter(server.sockets)).getsockname()[:2]
    return f"ws://[{host}]:{port}" if ":" in host else f"ws://{host}:{port}"


def _name(connection: "ServerConnection") -> str:
    address = connection.remote_address
    return f"{address[0]}:{address[1]}" if address else "a client"
