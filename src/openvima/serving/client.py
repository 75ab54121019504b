"""The client: a policy that asks a server what to do, over a connection of questions and answers."""

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any
from urllib.parse import urlsplit

from openvima.errors import MessageError, PolicyError, PolicyRaisedError, ServerError, echo
from openvima.policies.base import Policy
from openvima.scene import RenderedPrompt
from openvima.scene.action import CONTROLS, PRIMITIVES
from openvima.serving.protocol import (
    DEFAULT_MODALITIES,
    POLICY_FAILED,
    PROTOCOL,
    TOKEN_VARIABLE,
    check_address,
    check_form,
    check_modalities,
    decode_action,
    encode_observation,
    encode_prompt,
    is_loopback,
    pack,
    require_extra,
    unpack,
)

CONNECT_S = 10.0
CLOSE_S = 2.0
TIMEOUT_S = 300.0
MAX_REPLY_BYTES = 16 * 2**20  # actions are small, and metadata gets into results


class RemotePolicy(Policy):
    """A policy behind a WebSocket; it may be written in any language.

    It connects at once and keeps the connection, in which the server keeps the episodes. Whatever goes wrong
    in a connection, apart from a refusal, closes it. Only `reset` makes a new one, since what the server knew
    of the running episodes is gone.

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

    def __init__(self, url: str, *, token: str | None = None, timeout_s: float = TIMEOUT_S) -> None:
        require_extra()
        check_address(url)
        self.url, self._timeout_s = url, timeout_s
        self._token = token or os.environ.get(TOKEN_VARIABLE)
        self._num_episodes = 0
        self.near_ties: list[bool] = []  # see `NetworkPolicy.near_ties`; empty where the server does not say
        self.metadata = self._connect()
        with self._closed_by_errors():
            asked = self.metadata.get("modalities", DEFAULT_MODALITIES)
            self.modalities = check_modalities(asked)
            control = self.metadata.get("control", PRIMITIVES)
            self.control = check_form(control, CONTROLS, "control of the policy")

    def __enter__(self) -> "RemotePolicy":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __del__(self) -> None:
        with suppress(Exception):  # at the end of the program parts of it are gone
            self.close()

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Begin a batch of episodes.

        Raises:
            ServerError: The server is lost, or refuses; or there is another policy at its address now.
        """
        from websockets.protocol import State

        self._num_episodes, self.near_ties = 0, []
        if self._socket.state is not State.OPEN:
            before, self.metadata = self.metadata, self._connect()
            if self.metadata != before:
                self.close()
                raise ServerError(f"{self.url} serves another policy than before; begin a new evaluation.")
        self._ask({"type": "reset", "prompts": [encode_prompt(prompt) for prompt in prompts]})
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
        answer = self._ask(
            {"type": "act", "observations": [encode_observation(seen) for seen in observations]}
        )
        with self._closed_by_errors():
            check_form(answer, {"type": str, "actions": list, "near_ties?": list}, "act")
            actions = [
                decode_action(action, f"action {number}", control=self.control)
                for number, action in enumerate(answer["actions"])
            ]
            near_ties = answer.get("near_ties", [])
            if len(actions) != count or len(near_ties) not in (0, count):
                raise MessageError(f"actions, and near_ties if any, must be {count}, as the observations")
        self.near_ties = [near is True for near in near_ties]
        return actions

    def close(self) -> None:
        """Say goodbye to the server."""
        self._socket.close()

    def _connect(self) -> dict[str, Any]:
        """Open a connection; return the first frame, which says what is served and in which protocol."""
        from websockets.exceptions import InvalidStatus, WebSocketException
        from websockets.sync.client import connect

        url, wait_s = self.url, min(CONNECT_S, self._timeout_s)
        try:
            self._socket = connect(
                url,
                compression=None,
                max_size=MAX_REPLY_BYTES,
                open_timeout=wait_s,
                close_timeout=CLOSE_S,
                ping_interval=None,  # a server may compute for longer than a ping may take
                proxy=None if is_loopback(urlsplit(url).hostname or "") else True,
                additional_headers={"Authorization": f"Bearer {self._token}"} if self._token else None,
            )
        except InvalidStatus as error:
            said = (error.response.body or b"").decode(errors="replace").strip()
            raise ServerError(
                f"{url} refuses the connection (HTTP {error.response.status_code}: {echo(said)}); a token "
                f"can be given in the environment variable {TOKEN_VARIABLE}."
            ) from None
        except (OSError, WebSocketException) as error:
            reason = echo(str(error)) or type(error).__name__
            raise ServerError(
                f"no policy server answers at {url} ({reason}); start one with: openvima serve RUN"
            ) from error
        with self._closed_by_errors():
            data = self._socket.recv(timeout=wait_s)
            if isinstance(data, str):
                raise ServerError(f"{url} refuses: {echo(data)}")
            metadata = check_form(unpack(data), dict, "the first frame")
            check_form(metadata.get("protocol"), (PROTOCOL,), "the protocol")
            try:
                json.dumps(metadata, allow_nan=False)  # it gets into results.json
            except (TypeError, ValueError, RecursionError) as error:
                raise MessageError(f"its metadata holds other than plain, finite values ({error})") from None
        return metadata

    def _ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request and wait for its answer.

        Raises:
            ServerError: The server is lost, refuses, or answers what it must not.
            PolicyError: The policy refuses, or it raised.
        """
        request = pack(message)
        with self._closed_by_errors():
            self._socket.send(request)
            data = self._socket.recv(timeout=self._timeout_s)
        if isinstance(data, str):  # a refusal; the connection stays as it is
            # That of a policy names no address, since results keep it.
            if data.startswith(POLICY_FAILED):
                raise PolicyRaisedError(f"the policy on the server raised {echo(data[len(POLICY_FAILED) :])}")
            if re.match(r"(Policy|Prompt|Shape|Action)Error: ", data):
                raise PolicyError(f"the policy on the server refuses: {echo(data)}")
            raise ServerError(f"{self.url} refuses: {echo(data)}")
        with self._closed_by_errors():
            answer = check_form(unpack(data), dict, "the answer")
            check_form(answer.get("type"), (message["type"],), "the type of the answer")
        return answer

    @contextmanager
    def _closed_by_errors(self) -> Iterator[None]:
        """Close the connection if the block fails: answers that come later would be taken for others."""
        from websockets.exceptions import ConnectionClosed

        try:
            yield
        except BaseException as error:
            self.close()
            if isinstance(error, MessageError):
                said = f"{self.url} does not keep to {PROTOCOL}: {echo(str(error))}"
            elif isinstance(error, ConnectionClosed):
                said = f"the policy server at {self.url} has ended the connection ({echo(str(error))})."
            elif isinstance(error, TimeoutError):
                said = f"the policy server at {self.url} has not answered in time."
            else:
                raise
            raise ServerError(said) from error


def describe(url: str) -> dict[str, Any]:
    """Ask a server what it serves; see `RemotePolicy` for the errors."""
    with RemotePolicy(url) as policy:
        return policy.metadata
