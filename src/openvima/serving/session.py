"""One client of a policy server: its episodes, and the answers to its requests."""

import logging
import traceback
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from openvima.errors import MessageError, OpenVimaError, echo
from openvima.policies.base import Policy
from openvima.policies.prompt_limits import PromptLimits
from openvima.scene import RenderedPrompt
from openvima.scene.command import PRIMITIVES
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
from openvima.tasks.prompts import MULTIMODAL, described

# Objects in the images of a request, on average over the largest batch. The benchmark's hardest prompts have
# 20, and demonstrations as prompts three times as many; its observations have 9, and ids of arm and table.
MAX_IN_PROMPTS, MAX_IN_VIEW = 64, 24
_MAX_REFUSAL = 500  # characters of a refusal, of which what was sent takes 200 at most
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class PolicyCall:
    """A call that a policy is to compute.

    Args:
        kind: The name of the method.
        inputs: Its prompts or observations.
    """

    kind: Literal["reset", "act"]
    inputs: Sequence[Any]


# Gives the calls that an answer needs, is sent what they return, and returns the answer.
Calls = Generator[PolicyCall, Any, Any]  # Any: actions; plain values and arrays
ReplyCalls = Generator[PolicyCall, Any, bytes | str]


class Session:
    """Answers the requests of one client.

    A request is read and checked in one thread and answered in that of the policy, so one that is refused
    delays other clients only briefly. No method raises: a refusal is a text, and the next request may be a
    better one.

    Args:
        policy: Has no other user. Its `prompt_limits`, if any, bound the prompts.
        max_episodes: Episodes of the largest batch.
        prompts: Form in which the policy gets prompts, see `ServerConfig`.
    """

    def __init__(self, policy: Policy, max_episodes: int, prompts: str = MULTIMODAL) -> None:
        self.policy = policy
        self._limits: PromptLimits = getattr(policy, "prompt_limits", PromptLimits())
        self._control: str = getattr(policy, "control", PRIMITIVES)
        self._max_episodes = max_episodes
        self._prompts = prompts
        self._num_episodes = 0

    def read(self, data: bytes | str) -> Calls | str:
        """Read a request, whatever it is, and return what answers it; nothing is called yet."""
        try:
            return self._read(data)
        except OpenVimaError as error:
            return _refusal(error)

    def reply(self, request: Calls) -> ReplyCalls:
        """Answer a request that `read` returned. Whoever runs this makes the calls."""
        try:
            return pack((yield from request))
        except OpenVimaError as error:
            return _refusal(error)
        except Exception as error:  # of a policy that others wrote; the client learns that, we where it was
            where = "\n".join(map(echo, traceback.format_exc().splitlines()[-40:]))
            _LOG.error("the policy failed\n%s", where)
            return f"the policy failed: {type(error).__name__}: {echo(str(error))}"

    def _read(self, data: bytes | str) -> Calls:
        if isinstance(data, str):
            raise MessageError("a text frame came in; requests are binary frames of MessagePack.")
        message = unpack(data)
        kind = type_of(message)
        if kind == "reset":
            assert isinstance(message, dict)  # it has a type
            protocol = message.get("protocol", PROTOCOL)
            check_protocol(protocol, theirs="the client", ours="this server")
            prompts = read_list(message, "reset", "prompts", self._max_episodes, optional=("protocol",))
            return self._begin(self._decoded(prompts))
        if kind == "act":
            seen = read_list(message, "act", "observations", self._max_episodes)
            observations = [
                decode_observation(one, f"observation {n}", control=self._control)
                for n, one in enumerate(seen)
            ]
            num_ids = sum(_num_ids(one["segm"]) for one in observations if one and "segm" in one)
            self._check_objects(num_ids, MAX_IN_VIEW)
            return self._act(observations)
        if isinstance(message, dict) and "type" not in message:
            prompt = message.pop("prompt", None)
            sent = [] if prompt is None else [{"text": prompt} if isinstance(prompt, str) else prompt]
            return self._infer(decode_observation(message, control=self._control), self._decoded(sent))
        raise MessageError(
            f"a request must be a map with type 'reset' or 'act', or an observation ({PROTOCOL})."
        )

    def _decoded(self, sent: Sequence[object]) -> list[RenderedPrompt]:
        prompts = [decode_prompt(prompt, f"prompt {n}") for n, prompt in enumerate(sent)]
        for prompt in prompts:
            self._limits.check(prompt)
        num_objects = sum(len(image.objects) for prompt in prompts for image in prompt.images.values())
        self._check_objects(num_objects, MAX_IN_PROMPTS)
        return [described(prompt, self._prompts) for prompt in prompts]

    def _check_objects(self, count: int, per_episode: int) -> None:
        allowed = max(256, per_episode * self._max_episodes)  # of a single one as many as an image may have
        if count > allowed:
            raise MessageError(
                f"the images have {count:,} objects in all; at most {allowed:,} are allowed. "
                "Send fewer episodes."
            )

    def _begin(self, prompts: Sequence[RenderedPrompt]) -> Calls:
        yield from self._reset(prompts)
        return {"type": "reset", "episodes": self._num_episodes}

    def _reset(self, prompts: Sequence[RenderedPrompt]) -> Calls:
        if not prompts:
            raise MessageError("reset has no prompts; give one for each episode.")
        self._num_episodes = 0  # should the policy fail, there is nothing to go on with
        yield PolicyCall("reset", prompts)
        self._num_episodes = len(prompts)

    def _act(self, observations: Sequence[dict[str, Any] | None]) -> Calls:  # Any: values and arrays
        actions = yield from self._actions(observations)
        near_ties = getattr(self.policy, "near_ties", None)
        extra = {} if near_ties is None else {"near_ties": [bool(near) for near in near_ties]}
        return {"type": "act", "actions": actions, **extra}

    def _actions(self, observations: Sequence[dict[str, Any] | None]) -> Calls:  # Any: values and arrays
        """Ask the policy."""
        if not self._num_episodes:
            raise MessageError("there are no episodes yet; send a reset with their prompts first.")
        if len(observations) != self._num_episodes:
            raise MessageError(
                f"act has {len(observations)} observations for {self._num_episodes} prompts; send one for "
                "each, and nil for episodes that have ended."
            )
        given = yield PolicyCall("act", observations)
        actions = [encode_action(action, self._control) for action in given]
        if len(actions) != len(observations):
            raise MessageError(
                f"the policy gave {len(actions)} actions for {len(observations)} observations."
            )
        return actions

    def _infer(self, observation: dict[str, Any] | None, prompts: Sequence[RenderedPrompt]) -> Calls:
        """Act in a single episode, which an observation with a prompt begins."""
        if prompts:
            yield from self._reset(prompts)
        return (yield from self._actions([observation]))[0]


def _num_ids(segm: Mapping[str, np.ndarray]) -> int:
    """Count the values of a segmentation, in the view with most of them."""
    return max(
        (int(np.count_nonzero(np.bincount(ids.ravel(), minlength=256))) for ids in segm.values()), default=0
    )


def _refusal(error: OpenVimaError) -> str:
    return echo(f"{type(error).__name__}: {error}", _MAX_REFUSAL)
