"""Calls of several sessions of one network that are computed together, in pieces.

A server's clients each have a session of a few episodes. One batch of the episodes of all costs far less than
a batch for each, and a large call that is computed in pieces lets smaller ones in between.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch

from openvima.policies.episodes import Episodes, join
from openvima.scene import RenderedPrompt


class NetworkSession(Protocol):
    """What joint calls need of a `NetworkPolicy`; see there."""

    network: Any  # that of all sessions whose calls join each other

    def check_prompts(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Check prompts before they are encoded in pieces."""
        ...

    def start_episodes(self, prompts: Sequence[RenderedPrompt]) -> Episodes:
        """Encode prompts; the session does not change."""
        ...

    def begin(self, prompts: Sequence[RenderedPrompt], episodes: Episodes) -> None:
        """Make episodes those of the session."""
        ...

    def episodes_to_step(self, observations: Sequence[Mapping | None]) -> Episodes:
        """Return the episodes that have an observation."""
        ...

    def step_episodes(
        self, episodes: Episodes, observations: Sequence[Mapping], choices: list[torch.Tensor]
    ) -> Episodes:
        """Decode an action for each episode; the session does not change."""
        ...

    def go_on(self, episodes: Episodes) -> list[dict[str, np.ndarray] | None]:
        """Make episodes after a step those of the session, and return the actions."""
        ...


class JointCall:
    """A call of one session of a network.

    The session changes when the call is finished, and not if it fails.

    Args:
        policy: The session.
        inputs: What each row of the batch is computed from.
    """

    def __init__(self, policy: NetworkSession, inputs: Sequence[Any]) -> None:
        self._policy = policy
        self._inputs = inputs
        self._pieces: list[Episodes] = []
        self._num_done = 0

    @property
    def num_left(self) -> int:
        """Number of rows that are still to be computed."""
        return len(self._inputs) - self._num_done

    def joins(self, other: "JointCall") -> bool:
        """Whether both can be computed in one batch."""
        return type(self) is type(other) and self._policy.network is other._policy.network

    def finish(self) -> list[dict[str, np.ndarray] | None] | None:
        """Change the session, and return what the call returns."""
        raise NotImplementedError

    @staticmethod
    @torch.inference_mode()
    def compute_together(pieces: "Sequence[tuple[JointCall, int]]") -> None:
        """Compute the next rows of several calls in one batch.

        Args:
            pieces: Calls that join each other, and how many rows of each.

        Raises:
            OpenVimaError: As `reset` or `act`, of any of the calls; none of them has changed.
        """
        type(pieces[0][0])._compute(pieces)

    def _rows(self, count: int) -> slice:
        return slice(self._num_done, self._num_done + count)

    def _take(self, piece: Episodes) -> None:
        self._pieces.append(piece)
        self._num_done += len(piece)

    def _joined(self, indices: Sequence[int]) -> Episodes:
        return replace(join(self._pieces), indices=tuple(indices))

    @staticmethod
    def _compute(pieces: "Sequence[tuple[Any, int]]") -> None:
        raise NotImplementedError


class JointReset(JointCall):
    """`NetworkPolicy.reset`; see there for errors.

    Args:
        policy: The session.
        prompts: The prompts.
    """

    def __init__(self, policy: NetworkSession, prompts: Sequence[RenderedPrompt]) -> None:
        super().__init__(policy, prompts)
        policy.check_prompts(prompts)

    @torch.inference_mode()
    def finish(self) -> None:
        """Start the episodes."""
        self._policy.begin(self._inputs, self._joined(range(len(self._inputs))))

    @staticmethod
    def _compute(pieces: "Sequence[tuple[JointReset, int]]") -> None:
        prompts = [prompt for call, count in pieces for prompt in call._inputs[call._rows(count)]]
        episodes = pieces[0][0]._policy.start_episodes(prompts)
        parts = episodes.split([count for _, count in pieces]) if len(pieces) > 1 else [episodes]
        for (call, _), part in zip(pieces, parts, strict=True):
            call._take(part)


class JointAct(JointCall):
    """`NetworkPolicy.act`; see there for errors.

    Args:
        policy: The session.
        observations: One for each prompt, None for episodes that have ended.
    """

    def __init__(self, policy: NetworkSession, observations: Sequence[Mapping | None]) -> None:
        super().__init__(policy, [each for each in observations if each is not None])
        self._before = policy.episodes_to_step(observations)

    @torch.inference_mode()
    def finish(self) -> list[dict[str, np.ndarray] | None]:
        """Take the step, and return the actions."""
        if not self._pieces:  # all have ended
            return self._policy.go_on(self._before)
        return self._policy.go_on(self._joined(self._before.indices))

    @staticmethod
    def _compute(pieces: "Sequence[tuple[JointAct, int]]") -> None:
        parts = [call._before.select(call._before.indices[call._rows(count)]) for call, count in pieces]
        observations = [seen for call, count in pieces for seen in call._inputs[call._rows(count)]]
        after = pieces[0][0]._policy.step_episodes(join(parts), observations, [])
        for (call, _), part in zip(pieces, after.split_as(parts) if len(parts) > 1 else [after], strict=True):
            call._take(part)
