"""The running episodes of a batch, whose rows are selected, joined with those of other batches and split."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import torch

from openvima.policies.nn.decoder import KVCache
from openvima.policies.nn.tensor_record import join_rows, map_tensors


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
