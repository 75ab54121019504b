"""One client of a policy server: its episodes, and the answers to its requests."""

import logging
from collections.abc import Sequence
from typing import Any

from openvima.errors import MessageError, OpenVimaError
from openvima.policies.base import Policy
from openvima.scene import RenderedPrompt
from openvima.serving.packing import pack, unpack
from openvima.serving.protocol import (
    PROTOCOL,
    check_protocol,
    decode_observation,
    decode_prompt,
    encode_action,
    read_list,
    type_of,
)

_LOG = logging.getLogger(__name__)


class Session:
    """Answers the requests of one client.

    Args:
        policy: Has no other user.
        max_episodes: Episodes of the largest batch.
    """

    def __init__(self, policy: Policy, max_episodes: int) -> None:
        self._policy = policy
        self._max_episodes = max_episodes
        self._num_episodes = 0

    def reply(self, data: bytes | str) -> bytes | str:
        """Answer a request, whatever it is.

        Returns:
            The packed answer; or a text that says why there is none. The next request may be a better one.
        """
        try:
            return self._answer(data)
        except OpenVimaError as error:
            return f"{type(error).__name__}: {error}"
        except Exception as error:  # of a policy that others wrote; the client learns that, we where it was
            _LOG.exception("the policy failed")
            return f"the policy failed: {type(error).__name__}: {error}"[:1000]

    def _answer(self, data: bytes | str) -> bytes:
        if isinstance(data, str):
            raise MessageError("a text frame came in; requests are binary frames of MessagePack.")
        message = unpack(data)
        kind = type_of(message)
        if kind == "reset":
            assert isinstance(message, dict)  # it has a type
            protocol = message.get("protocol", PROTOCOL)
            check_protocol(protocol, theirs="the client", ours="this server")
            prompts = read_list(message, "reset", "prompts", self._max_episodes, optional=("protocol",))
            self._reset([decode_prompt(prompt, f"prompt {n}") for n, prompt in enumerate(prompts)])
            return pack({"type": "reset", "episodes": self._num_episodes})
        if kind == "act":
            seen = read_list(message, "act", "observations", self._max_episodes)
            actions = self._act([decode_observation(one, f"observation {n}") for n, one in enumerate(seen)])
            near_ties = getattr(self._policy, "near_ties", None)
            extra = {} if near_ties is None else {"near_ties": [bool(near) for near in near_ties]}
            return pack({"type": "act", "actions": actions, **extra})
        if isinstance(message, dict) and "type" not in message:
            return pack(self._infer(message))
        raise MessageError(
            f"a request must be a map with type 'reset' or 'act', or an observation ({PROTOCOL})."
        )

    def _reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        if not prompts:
            raise MessageError("reset has no prompts; give one for each episode.")
        self._num_episodes = 0  # should the policy fail, there is nothing to go on with
        self._policy.reset(prompts)
        self._num_episodes = len(prompts)

    def _act(self, observations: Sequence[dict[str, Any] | None]) -> list[dict[str, Any] | None]:
        """Ask the policy; Any: plain values and arrays."""
        if not self._num_episodes:
            raise MessageError("there are no episodes yet; send a reset with their prompts first.")
        if len(observations) != self._num_episodes:
            raise MessageError(
                f"act has {len(observations)} observations for {self._num_episodes} prompts; send one for "
                "each, and nil for episodes that have ended."
            )
        actions = [encode_action(action) for action in self._policy.act(observations)]
        if len(actions) != len(observations):
            raise MessageError(
                f"the policy gave {len(actions)} actions for {len(observations)} observations."
            )
        return actions

    def _infer(self, message: dict[str, Any]) -> dict[str, Any] | None:
        """Act in a single episode, which an observation with a prompt begins."""
        fields = dict(message)
        prompt = fields.pop("prompt", None)
        observation = decode_observation(fields)
        if prompt is not None:
            self._reset([decode_prompt({"text": prompt} if isinstance(prompt, str) else prompt)])
        return self._act([observation])[0]
