"""The running episodes of a batch, whose rows are selected, joined with those of other batches and split."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Protocol

import numpy as np
import torch

from openvima.policies.nn.decoder import KVCache
from openvima.policies.nn.tensor_record import join_rows, map_tensors
from openvima.scene import RenderedPrompt


@dataclass(frozen=True, slots=True, eq=False)
class Episodes:
    """The running episodes of a batch; never changed in place.

    Args:
        indices: Index of each episode in the batch that `reset` began.
        num_slots: Object slots of each episode, see `Processor.encode_observations`.
        generators: One for each episode, to sample actions.
        prompt: Encoded prompts.
        state: Decoding state.
        actions_BC: Last actions, metres and quaternions, float32; zero before the first step.
        has_acted: Whether each episode has made a step.
        margins_B: Smallest difference between the best and second-best logit over the components of the last
            action; None before the first step.
        features: Features of the images of the last step, or of the prompts, by digest.
    """

    indices: tuple[int, ...]
    num_slots: tuple[int, ...]
    generators: tuple[torch.Generator, ...]
    prompt: Any  # the model's own record
    state: Any  # likewise
    actions_BC: torch.Tensor
    has_acted: tuple[bool, ...]
    margins_B: torch.Tensor | None
    features: Mapping[bytes, torch.Tensor]

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def cache(self) -> KVCache:
        """Keys and values of the decoding state."""
        return getattr(self.state, "cache", self.state)

    def select(self, indices: Sequence[int]) -> "Episodes":
        """Return the episodes with these indices in the batch."""
        rows = [self.indices.index(index) for index in indices]
        if len(rows) == len(self.indices):
            return self
        return Episodes(
            tuple(indices),
            tuple(self.num_slots[row] for row in rows),
            tuple(self.generators[row] for row in rows),
            self.prompt.select(rows),
            self.state.select(rows),
            self.actions_BC[rows],
            tuple(self.has_acted[row] for row in rows),
            None if self.margins_B is None else self.margins_B[rows],
            self.features,
        )

    def split(self, counts: Sequence[int]) -> list["Episodes"]:
        """Split into consecutive batches of so many episodes, copied and numbered from 0.

        They are copied so that no batch is kept for the sake of a row.
        """
        end, split = 0, []
        for count in counts:
            rows = slice(end, end := end + count)
            split.append(
                Episodes(
                    tuple(range(count)),
                    self.num_slots[rows],
                    self.generators[rows],
                    _rows(self.prompt, rows),
                    _compact_rows(self.state, rows),
                    self.actions_BC[rows].clone(),
                    self.has_acted[rows],
                    None if self.margins_B is None else self.margins_B[rows].clone(),
                    self.features,
                )
            )
        return split

    def split_as(self, parts: Sequence["Episodes"]) -> list["Episodes"]:
        """Undo `join` after a step; prompts are those of the parts, without the padding of others."""
        without_prompts = replace(self, prompt=None, state=_with_prompt(self.state, (), None))
        split = without_prompts.split([len(part) for part in parts])
        return [
            replace(
                rows,
                indices=part.indices,
                prompt=part.prompt,
                state=_with_prompt(rows.state, part.cache.prompt, part.cache.prompt_mask_BP),
            )
            for rows, part in zip(split, parts, strict=True)
        ]


def join(parts: Sequence[Episodes]) -> Episodes:
    """Join episodes of several batches, which may have made different numbers of steps, to one batch.

    Returns:
        The episodes in the order of the parts, numbered from 0.
    """
    if len(parts) == 1:
        return parts[0]
    counts = [len(part) for part in parts]
    has_margins = all(part.margins_B is not None for part in parts)
    return Episodes(
        tuple(range(sum(counts))),
        tuple(chain.from_iterable(part.num_slots for part in parts)),
        tuple(chain.from_iterable(part.generators for part in parts)),
        join_rows([part.prompt for part in parts], counts),
        join_rows([part.state for part in parts], counts),
        torch.cat([part.actions_BC for part in parts]),
        tuple(chain.from_iterable(part.has_acted for part in parts)),
        join_rows([part.margins_B for part in parts], counts) if has_margins else None,
        {key: value for part in parts for key, value in part.features.items()},
    )


def _rows(record: Any, rows: slice) -> Any:  # Any: of its own kind
    return map_tensors(record, lambda tensor: tensor[rows].clone())


def _compact_rows(state: Any, rows: slice) -> Any:  # Any: of its own kind
    """Copy rows of a decoding state, without positions that none of them attends to."""
    cache: KVCache = getattr(state, "cache", state)
    kept_S = cache.mask_BS[rows].any(dim=0).nonzero()[:, 0]
    compact = replace(
        _rows(replace(cache, past=()), rows),
        past=map_tensors(cache.past, lambda keys: keys[rows].index_select(2, kept_S)),
        mask_BS=cache.mask_BS[rows].index_select(1, kept_S),
    )
    return compact if cache is state else replace(_rows(replace(state, cache=None), rows), cache=compact)


def _with_prompt(state: Any, prompt: Any, mask_BP: Any) -> Any:  # Any: of its own kind, or nothing
    """Return the state with other keys and values of the prompt."""
    cache = replace(getattr(state, "cache", state), prompt=prompt, prompt_mask_BP=mask_BP)
    return cache if isinstance(state, KVCache) else replace(state, cache=cache)


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
