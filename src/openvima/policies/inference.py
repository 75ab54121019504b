"""Inference: a network as a policy, with cached prompts and decoding states for a batch of episodes."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from openvima.errors import PolicyError
from openvima.perception.objects import ObjectExtractor
from openvima.perception.preprocessing import ImageStack
from openvima.policies.base import POLICIES_THAT_EXPLAIN, Policy, prompt_hash, usable_device
from openvima.policies.checkpoint import save_checkpoint
from openvima.policies.nn.actions import ACTION_PARTS, ACTION_WIDTH, greedy, sampling
from openvima.policies.nn.layers import TensorRecord
from openvima.policies.nn.policy_network import Decoded, PolicyNetwork, StepInputs
from openvima.policies.processor import PROMPT_LIMITS, Processor
from openvima.policies.t5 import tokenizer_for
from openvima.policies.tokenizer import Tokenizer
from openvima.scene import RenderedPrompt
from openvima.scene.explanation import Explanation

# Pairs of tokens within a prompt, over a padded batch: 16 prompts of 256 tokens, 64 of 128. Attention scores
# take memory for each.
MAX_PROMPT_PAIRS = 2**20
MAX_CACHED_TOKENS = 2**15  # of the histories of a padded batch: 64 of 512, as long as any may be
# Images that are encoded at once. On an accelerator that bounds the memory of a large batch; on a CPU what is
# computed of them stays in the cache of a core, and the crops of 16 episodes take four fifths of the time.
MAX_CROPS, MAX_CROPS_ON_CPU = 1024, 16
NEAR_TIE = 1e-4  # difference of two logits below which float32 rounding may swap their order


@dataclass(frozen=True, slots=True, eq=False)
class _Episodes(TensorRecord):
    """The running episodes of a batch; never changed in place.

    Args:
        indices: Index of each episode in the batch that `reset` began.
        num_slots: Object slots of each episode, see `Processor.encode_observations`.
        generators: One for each episode, to sample actions.
        prompt: Encoded prompts.
        state: Decoding state.
        actions_BC: Last actions, metres and quaternions, float32; zero before the first step.
        has_acted: Whether the episodes have made a step.
        margins_B: Smallest difference between the best and second-best logit over the components of the last
            action; None before the first step.
        features: Features of the images of the last step, or of the prompts, by digest.
    """

    indices: tuple[int, ...]
    num_slots: tuple[int, ...]
    generators: tuple[torch.Generator, ...]
    prompt: Any  # the network's own record
    state: Any  # likewise
    actions_BC: torch.Tensor
    has_acted: bool
    margins_B: torch.Tensor | None
    features: Mapping[bytes, torch.Tensor]

    def actions(self) -> list[dict[str, np.ndarray]]:
        """Return the last action of each episode."""
        return [
            {key: action_C[part].copy() for key, part in ACTION_PARTS.items()}
            for action_C in self.actions_BC.cpu().numpy()
        ]

    def keep(self, indices: Sequence[int]) -> "_Episodes":
        """Return the episodes with these indices in the batch."""
        rows = [self.indices.index(index) for index in indices]
        if len(rows) == len(self.indices):
            return self
        return replace(
            self.select(rows),
            indices=tuple(indices),
            num_slots=tuple(self.num_slots[row] for row in rows),
            generators=tuple(self.generators[row] for row in rows),
        )


# What `explain` needs to decode a step once more: observations of the episodes that acted, what was decoded
# from, and what was decoded.
_Step = tuple[Sequence[Mapping], StepInputs, Decoded]


class NetworkPolicy(Policy):
    """Runs a network on a batch of episodes; an episode's actions do not depend on the rest of the batch.

    The prompt is encoded once and keys and values are cached, so a step costs only its own tokens. On a CPU
    the default precision is float64: rounding, which varies with the batch shape, then stays far below the
    float32 of the returned actions, and an episode gets the same actions in any batch. In float32 and
    bfloat16 this holds except for near ties; large networks are several times faster there.

    An error in `reset` or `act` leaves the policy unchanged.

    Args:
        network: The network; it is moved to the device and precision, and set to evaluation mode.
        tokenizer: Tokenizer of prompts; by default the benchmark's vocabulary, for networks with fresh
            weights.
        extractor: Extracts objects from images; by default from the simulator's segmentation.
        device: Device, such as "cpu" or "cuda".
        dtype: Precision; by default float64 on a CPU and float32 elsewhere.
        temperature: 0 for greedy decoding. Above 0 actions are sampled, with logits divided by it.
        generator: Required for sampling. Each episode samples from a seed derived from the generator's and
            the prompt, independent of other episodes; the generator itself does not change.

    Raises:
        PolicyError: The temperature is negative or not finite, or above 0 without a generator; the network
            needs the T5 tokenizer and none is given; or the device is not available.
    """

    prompt_limits = PROMPT_LIMITS

    def __init__(
        self,
        network: PolicyNetwork,
        *,
        tokenizer: Tokenizer | None = None,
        extractor: ObjectExtractor | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype | None = None,
        temperature: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> None:
        if not 0 <= temperature < math.inf or (temperature > 0 and generator is None):
            raise PolicyError(
                f"temperature is {temperature:g}; it must be 0, or a finite number above 0 with a generator "
                "to sample with."
            )
        tokenizer = tokenizer or tokenizer_for(network.config.prompt)
        self.processor = Processor(*network.config.inputs, tokenizer=tokenizer, extractor=extractor)
        self.device = usable_device(device)
        self.dtype = dtype or (torch.float64 if self.device.type == "cpu" else torch.float32)
        self.network = network.to(self.device, self.dtype).eval()
        if self.device.type == "cpu":
            # Crops are in channels_last; kernels in another memory format would be copied at every call, a
            # third of the cost of a few crops.
            self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._temperature = temperature
        self._seed = generator.initial_seed() if generator else 0
        self._is_bounded = False  # batches of one's own may be as large as the memory allows
        self._prompts: tuple[RenderedPrompt, ...] = ()
        self._episodes: _Episodes | None = None
        self._last_step: _Step | None = None

    @torch.inference_mode()
    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Start a batch of episodes.

        Raises:
            PolicyError: The batch is empty, a prompt is too long, or a session's batch is too large for it.
            PromptError: A prompt is empty, T5 lacks a word, or placeholders and images do not match.
            ShapeError: An image has another shape or dtype.
        """
        if isinstance(prompts, RenderedPrompt) or not all(isinstance(p, RenderedPrompt) for p in prompts):
            raise PolicyError("reset takes a list of rendered prompts, such as [env.prompt].")
        if not prompts:
            raise PolicyError("reset got no prompts; give one for each episode.")
        batch, stack = self.processor.encode_prompts(prompts)
        count, length = batch.word_ids_BL.shape
        if self._is_bounded and count * length**2 > MAX_PROMPT_PAIRS:
            raise PolicyError(
                f"{count} prompts of up to {length} tokens are too many at once; this policy takes "
                f"{MAX_PROMPT_PAIRS // length**2} of that length. Reset with fewer episodes (--batch)."
            )
        features_KF, features = self._encode(stack, {})
        prompt = self.network.encode_prompt(batch.to(self.device), features_KF)
        # Without sampling no generator is used, and hashing images takes 3 % of an evaluation.
        seeds = [self._seed ^ prompt_hash(prompt) if self._temperature else 0 for prompt in prompts]
        self._episodes = _Episodes(
            indices=tuple(range(count)),
            num_slots=(0,) * count,
            generators=tuple(torch.Generator().manual_seed(seed & (2**63 - 1)) for seed in seeds),
            prompt=prompt,
            state=self.network.init_cache(prompt),
            actions_BC=torch.zeros(count, ACTION_WIDTH, device=self.device),
            has_acted=False,
            margins_B=None,
            features=features,
        )
        self._prompts, self._last_step = tuple(prompts), None

    @torch.inference_mode()
    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        """Decide the next action of every episode.

        Args:
            observations: One for each prompt; None from the end of its episode on.

        Returns:
            An action for each observation, float32 arrays within the bounds; None for None.

        Raises:
            PolicyError: `reset` was not called, or with another number of prompts; an observation follows the
                end of its episode; no object is visible; or a history is too long.
            ShapeError: An image has another shape or dtype.
        """
        episodes, last = self._running_episodes(observations), None
        if running := [each for each in observations if each is not None]:
            episodes, last = self._step(episodes, running)
        if self.network.explains and not self._is_bounded:  # the caches before a step take memory
            self._last_step = last
        self._episodes = episodes
        actions: list[dict[str, np.ndarray] | None] = [None] * len(self._prompts)
        for index, action in zip(episodes.indices, episodes.actions(), strict=True):
            actions[index] = action
        return actions

    @torch.inference_mode()
    def explain(self) -> list[Explanation | None]:
        """Explain the last actions. The step is decoded once more; nothing changes.

        Returns:
            For each episode what was considered; None for those that have ended.

        Raises:
            PolicyError: There is no last action, or the network has no explanations.
        """
        if not self.network.explains:
            kind = self.network.config.architecture.capitalize()
            raise PolicyError(f"a policy of kind {kind} has no explain(). {POLICIES_THAT_EXPLAIN}")
        explanations: list[Explanation | None] = [None] * len(self._prompts)
        episodes, last = self._episodes, self._last_step
        if episodes is not None and not episodes.indices:  # all have ended
            return explanations
        if last is None or episodes is None:
            raise PolicyError(
                "there is no action to explain; call act first. Sessions of a server keep none."
            )
        from openvima.policies.explaining import explain_row

        seen, inputs, decoded = last
        trace = self.network.explain_step(inputs, decoded)
        for row, (index, action) in enumerate(zip(episodes.indices, episodes.actions(), strict=True)):
            explanations[index] = explain_row(
                trace,
                row,
                action,
                self._prompts[index],
                seen[row],
                self.processor,
                temperature=self._temperature,
                follow_coreference=getattr(self.network.config, "coreference", False),
            )
        return explanations

    def new_session(self) -> "NetworkPolicy":
        """Return a policy for one client: it shares the network and has its own, bounded batches."""
        other = copy(self)
        other._is_bounded = True
        # Never changed in place, so nothing else is shared.
        other._prompts, other._episodes, other._last_step = (), None, None
        return other

    @property
    def near_ties(self) -> list[bool]:
        """Whether rounding may have decided each episode's last action; False for ended episodes.

        That is the case if the two best logits of a component differ by less than `NEAR_TIE`.
        """
        near = [False] * len(self._prompts)
        if self._episodes is not None and self._episodes.margins_B is not None:
            margins = self._episodes.margins_B.tolist()
            for index, margin in zip(self._episodes.indices, margins, strict=True):
                near[index] = margin < NEAR_TIE
        return near

    def save_pretrained(self, folder: str | Path, *, dtype: torch.dtype = torch.float32) -> None:
        """Write a checkpoint folder; see `openvima.policies.checkpoint.save_checkpoint`.

        Args:
            folder: The folder; an existing checkpoint is replaced.
            dtype: Precision of the stored weights, independent of the policy's own.
        """
        save_checkpoint(self.network, folder, self.processor.tokenizer, dtype=dtype)

    def _running_episodes(self, observations: Sequence[Mapping | None]) -> _Episodes:
        """Return the episodes that have an observation."""
        if self._episodes is None:
            raise PolicyError("there are no prompts yet; call reset with one for each episode first.")
        if isinstance(observations, Mapping):
            raise PolicyError("act takes a list of observations, one for each prompt, such as [observation].")
        if len(observations) != len(self._prompts):
            raise PolicyError(
                f"got {len(observations)} observations for {len(self._prompts)} prompts; give one for each, "
                "and None for episodes that have ended."
            )
        running = [index for index, each in enumerate(observations) if each is not None]
        ended = sorted(set(running).difference(self._episodes.indices))
        if ended:
            raise PolicyError(
                f"episode {', '.join(map(str, ended))} ended with a None before; call reset to start again."
            )
        episodes = self._episodes.keep(running)
        cached = getattr(episodes.state, "cache", episodes.state).mask_BS  # of keys and values
        if self._is_bounded and cached.numel() > MAX_CACHED_TOKENS:
            raise PolicyError(
                f"the histories of {len(cached)} episodes have {cached.shape[1]} tokens each, padded; this "
                f"policy takes {MAX_CACHED_TOKENS:,} in all. Act in fewer episodes (--batch) or steps."
            )
        return episodes

    def _step(
        self,
        episodes: _Episodes,
        observations: Sequence[Mapping],
    ) -> tuple[_Episodes, _Step]:
        """Decode one action for every episode."""
        batch, stack = self.processor.encode_observations(
            [[each] for each in observations], episodes.num_slots
        )
        features_KF, features = self._encode(stack, episodes.features)
        inputs = StepInputs(
            episodes.prompt,
            episodes.state,
            batch if self.device.type == "cpu" else batch.to(self.device),
            features_KF,
            episodes.actions_BC[:, None],
            torch.full((len(observations), 1), episodes.has_acted, device=self.device),
        )
        decoded: list[tuple[torch.Tensor, torch.Tensor]] = []
        strategy = sampling(episodes.generators, self._temperature) if self._temperature else greedy

        def record(logits: torch.Tensor) -> torch.Tensor:
            decoded.append((logits, strategy(logits)))
            return decoded[-1][1]

        actions_B1C, state = self.network.decode_step(inputs, record)
        best = [logits.topk(2).values for logits, _ in decoded if logits.shape[-1] > 1]
        margins = [(two[..., 0] - two[..., 1]).flatten(1).amin(1) for two in best]
        after = replace(
            episodes,
            num_slots=tuple(batch.num_slots_BT[:, 0].tolist()),
            state=state,
            actions_BC=actions_B1C[:, 0].to(torch.float32),  # the history holds actions as returned
            has_acted=True,
            margins_B=torch.stack(margins).amin(0) if margins else None,
            features=features,
        )
        return after, (observations, inputs, decoded)

    def _encode(
        self, stack: ImageStack, cached: Mapping[bytes, torch.Tensor]
    ) -> tuple[torch.Tensor, dict[bytes, torch.Tensor]]:
        """Encode new images only; most crops are unchanged since the last step.

        Returns:
            Features of all images, and the same by digest.
        """
        images, keys = stack.images(), stack.digests()
        new = [number for number, key in enumerate(keys) if key not in cached]
        count = MAX_CROPS_ON_CPU if self.device.type == "cpu" else MAX_CROPS
        chunks = torch.from_numpy(images[new]).split(count)
        encoded = torch.cat([self.network.encode_images(chunk.to(self.device)) for chunk in chunks])
        by_key = {**cached, **dict(zip((keys[number] for number in new), encoded, strict=True))}
        features = torch.stack([by_key[key] for key in keys])
        return features, dict(zip(keys, features, strict=True))
