"""The client: a policy that asks a server what to do."""

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from openvima.errors import MessageError, PolicyError, ServerError
from openvima.policies.base import Policy
from openvima.scene import RenderedPrompt
from openvima.scene.command import PRIMITIVES
from openvima.serving.connection import Connection
from openvima.serving.packing import pack, require_extra
from openvima.serving.protocol import (
    DEFAULT_MODALITIES,
    PROTOCOL,
    TOKEN_VARIABLE,
    check_control,
    check_modalities,
    check_token,
    decode_action,
    encode_observation,
    encode_prompt,
    read_list,
)

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

    def record(self) -> dict[str, Any]:  # Any: plain values
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

    def act(self, observations: Sequence[Mapping | None]) -> list[Any]:  # Any: of its control
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


def describe(url: str) -> dict[str, Any]:  # Any: plain values
    """Ask a server what it serves; see `RemotePolicy` for the errors."""
    with RemotePolicy(url) as policy:
        return policy.record()
