"""The policy server: loads nothing itself, serves a policy that exists, to several clients at once."""

import asyncio
import hmac
import http
import logging
import socket
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from openvima import __version__
from openvima.errors import ConfigError, MessageError, OpenVimaError, echo
from openvima.policies.base import Policy, PromptLimits
from openvima.policies.loading import checked_policy
from openvima.scene.action import CONTROLS, PRIMITIVES
from openvima.serving.protocol import (
    DEFAULT_MODALITIES,
    POLICY_FAILED,
    PROTOCOL,
    TOKEN_VARIABLE,
    check_form,
    check_modalities,
    decode_observation,
    decode_prompt,
    encode_action,
    is_loopback,
    pack,
    require_extra,
    unpack,
)
from openvima.tasks.prompts import check_prompts, describe

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

_MAX_REFUSAL = 500  # characters of a refusal, of which what was sent takes 200 at most
HEALTH_PATH = "/healthz"
CLOSE_S = 2.0  # for the other side to say goodbye
_Started = Future[tuple[str, asyncio.AbstractEventLoop, asyncio.Event]]  # URL, loop, and what stops it
_LOG = logging.getLogger(__name__)
_TRANSPORT_LOG = logging.getLogger(f"{__name__}.transport")
_TRANSPORT_LOG.setLevel(logging.CRITICAL)  # a traceback for every port scan; `serve_client` says what matters


@dataclass(frozen=True, slots=True)
class ServerConfig:
    """Where a policy is served, and what its clients may ask for.

    Args:
        host: Interface to listen on. Any but the loopback interface needs a token.
        port: TCP port; 0 takes a free one.
        token: Clients must know it. None, or an empty one, lets in everyone who reaches the port.
        max_message_bytes: Size of the largest message. A prompt image takes 0.26 MB, and so does an
            observation.
        max_episodes: Episodes of the largest batch, for which 128 MiB are enough.
        max_connections: Clients at the same time.
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
    idle_s: float = 600.0
    num_threads: int = 1
    prompts: str = "multimodal"

    def __post_init__(self) -> None:
        for name in ("max_message_bytes", "max_episodes", "max_connections", "idle_s", "num_threads"):
            if (value := getattr(self, name)) <= 0:
                raise ConfigError(f"{name} is {value:g}; it must be a positive number.")
        if not self.token and not is_loopback(self.host):
            raise ConfigError(
                f"host is {self.host!r}, which other machines may reach; give a token in "
                f"{TOKEN_VARIABLE}, or serve on 127.0.0.1 and let clients in through `ssh -L`."
            )
        check_prompts(self.prompts)


def is_own_page(headers: Mapping[str, str]) -> bool:
    """Whether a browser opens a WebSocket from a page of the same server, under a name of this machine alone.

    Other sites could give a name of theirs the address of this machine, and use what they cannot reach.

    Args:
        headers: Of the request.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    is_same = origin is None or urlsplit(origin).netloc == host
    return is_same and is_loopback(urlsplit(f"//{host}").hostname or "")


def check_can_listen(host: str, port: int) -> None:
    """Check that an address can be listened on, for servers that would try other ports or wait for ever.

    Raises:
        ConfigError: It is taken, or not one of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind((host, port))
    except (OSError, OverflowError) as error:
        raise ConfigError(f"cannot listen on {host}, port {port}: {error}; choose another one.") from error


class Session:
    """Answers the requests of one client.

    A refusal is a text, no exception: the next request may be a better one.

    Args:
        policy: Has no other user. Its `prompt_limits`, if any, bound the prompts.
        config: Has the largest batch, and the form in which the policy gets prompts.
    """

    def __init__(self, policy: Policy, config: ServerConfig) -> None:
        self.policy, self._config = policy, config
        self._limits: PromptLimits = getattr(policy, "prompt_limits", PromptLimits())
        self._control: str = getattr(policy, "control", PRIMITIVES)
        self._num_episodes = 0

    def answer(self, data: bytes | str) -> bytes | str:
        """Answer a request, whatever it is."""
        try:
            return pack(self._answer(data))
        except OpenVimaError as error:
            return echo(f"{type(error).__name__}: {error}", _MAX_REFUSAL)
        except Exception as error:  # of a policy that others wrote; the client learns that, we where it was
            where = "\n".join(map(echo, traceback.format_exc().splitlines()))
            _LOG.error("the policy failed\n%s", where)
            return f"{POLICY_FAILED}{type(error).__name__}: {echo(str(error))}"

    def _answer(self, data: bytes | str) -> Any:
        if isinstance(data, str):
            raise MessageError("a text frame came in; requests are binary frames of MessagePack.")
        message = unpack(data)
        if "type" not in check_form(message, dict, "the request"):  # a step of a single episode
            prompt = message.pop("prompt", None)
            observation = decode_observation(message, control=self._control)
            if prompt is not None:
                self._begin([{"text": prompt} if isinstance(prompt, str) else prompt])
            return self._actions([observation])[0]
        if check_form(message["type"], ("reset", "act"), "type of the request") == "reset":
            self._begin(self._listed(message, "prompts"))
            return {"type": "reset"}
        seen = self._listed(message, "observations")
        actions = self._actions(
            [decode_observation(one, f"observation {n}", control=self._control) for n, one in enumerate(seen)]
        )
        near_ties = getattr(self.policy, "near_ties", None)
        extra = {} if near_ties is None else {"near_ties": [bool(near) for near in near_ties]}
        return {"type": "act", "actions": actions, **extra}

    def _listed(self, message: object, field: str) -> list:
        values = check_form(message, {"type": str, field: list}, "the request")[field]
        if len(values) > (most := self._config.max_episodes):
            raise MessageError(
                f"there are {len(values)} {field}; at most {most} are allowed. Lower --batch, or serve with "
                "a higher --max-episodes."
            )
        return values

    def _begin(self, sent: Sequence[object]) -> None:
        prompts = [decode_prompt(prompt, f"prompt {n}") for n, prompt in enumerate(sent)]
        for prompt in prompts:
            self._limits.check(prompt)
        if not prompts:
            raise MessageError("reset has no prompts; give one for each episode.")
        self._num_episodes = 0  # should the policy fail, there is nothing to go on with
        self.policy.reset([describe(prompt, self._config.prompts) for prompt in prompts])
        self._num_episodes = len(prompts)

    def _actions(self, observations: Sequence[dict[str, Any] | None]) -> list[Any]:
        if not self._num_episodes:
            raise MessageError("there are no episodes yet; send a reset with their prompts first.")
        if len(observations) != self._num_episodes:
            raise MessageError(
                f"act has {len(observations)} observations for {self._num_episodes} prompts; send one for "
                "each, and nil for episodes that have ended."
            )
        actions = [encode_action(action) for action in self.policy.act(observations)]
        if len(actions) != len(observations):
            raise MessageError(
                f"the policy gave {len(actions)} actions for {len(observations)} observations."
            )
        return actions


def serve(
    policy: Policy,
    *,
    port: int = 8000,
    about: Mapping[str, Any] | None = None,
    ready: Callable[[str], None] | None = None,
    **settings: Any,
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
    with serve_in_thread(policy, port=port, about=about, **settings) as url:
        if ready is not None:
            ready(url)
        threading.Event().wait()


@contextmanager
def serve_in_thread(
    policy: Policy,
    *,
    port: int = 0,
    about: Mapping[str, Any] | None = None,
    **settings: Any,
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
    server = _PolicyServer(policy, config := ServerConfig(port=port, **settings), about or {})
    check_can_listen(config.host, config.port)
    started: _Started = Future()

    def work() -> None:
        try:
            asyncio.run(server.run(started))
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)

    thread = threading.Thread(target=work, name="openvima-serve", daemon=True)
    thread.start()
    url, loop, stop = started.result()
    try:
        yield url
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join()


class _PolicyServer:
    """A served policy.

    Connections share one event loop, in which nothing takes long. Requests are answered in one other thread,
    so that policies need not be safe to use from several.
    """

    def __init__(self, policy: Policy, config: ServerConfig, about: Mapping[str, Any]) -> None:
        checked_policy(policy, "the policy is")
        self._config = config
        self._new_policy: Callable[[], Policy] = getattr(policy, "new_session", lambda: policy)
        self._max_connections = config.max_connections if hasattr(policy, "new_session") else 1
        self._num_connections = 0
        modalities = check_modalities(getattr(policy, "modalities", DEFAULT_MODALITIES))
        control = check_form(getattr(policy, "control", PRIMITIVES), CONTROLS, "control of the policy")
        first = {"protocol": PROTOCOL, "versions": {"openvima": __version__}}
        self._metadata = pack({**first, **about, "modalities": modalities, "control": control})

    async def run(self, started: _Started) -> None:
        """Serve until the event is set that is given once clients can connect."""
        from websockets.asyncio.server import serve

        config, stop = self._config, asyncio.Event()
        with ThreadPoolExecutor(1, "openvima-policy", _set_threads, (config.num_threads,)) as self._computing:
            async with serve(
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
            ) as server:
                host, port = next(iter(server.sockets)).getsockname()[:2]
                url = f"ws://[{host}]:{port}" if ":" in host else f"ws://{host}:{port}"
                started.set_result((url, asyncio.get_running_loop(), stop))
                await stop.wait()

    def _admit(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        """Answer health checks, and turn away who does not know the token."""
        if request.path == HEALTH_PATH:
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        token = self._config.token or ""
        given = " ".join(request.headers.get_all("Authorization")).partition(" ")[2]  # scheme, then token
        if not token or hmac.compare_digest(given.encode(errors="replace"), token.encode()):
            return None
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
            await connection.send(text)
            await connection.close(CloseCode.TRY_AGAIN_LATER, text)
            return
        self._num_connections += 1
        _LOG.info("%s: connected", _name(connection))
        session, loop = Session(self._new_policy(), self._config), asyncio.get_running_loop()
        reply: bytes | str = self._metadata
        try:
            while True:
                async with asyncio.timeout(self._config.idle_s):
                    await connection.send(reply)
                    data = await connection.recv()
                reply = await loop.run_in_executor(self._computing, session.answer, data)
                if isinstance(reply, str):
                    _LOG.warning("%s: refused: %s", _name(connection), reply)
        except TimeoutError:
            reason = f"no whole message within {self._config.idle_s:g} s"
            _LOG.warning("%s: dropped, %s", _name(connection), reason)
            await connection.close(CloseCode.POLICY_VIOLATION, reason)
        except ConnectionClosed as closed:
            _LOG.info("%s: gone (%s)", _name(connection), echo(str(closed)))
        finally:
            self._num_connections -= 1


def _set_threads(num_threads: int) -> None:
    """Runs in the thread that computes: torch keeps the number for each thread."""
    if (torch := sys.modules.get("torch")) is not None:  # else no policy can use it
        torch.set_num_threads(num_threads)


def _name(connection: "ServerConnection") -> str:
    address = connection.remote_address
    return f"{address[0]}:{address[1]}" if address else "a client"
