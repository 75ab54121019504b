"""A network as a policy: keeps what it has read of a batch of episodes and decides each step."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from openvima.errors import PolicyError
from openvima.perception.image_stack import ImageStack
from openvima.perception.objects import ObjectExtractor
from openvima.policies.base import Policy, prompt_number
from openvima.policies.devices import usable_device
from openvima.policies.nn.actions import ACTION_PARTS, ACTION_WIDTH, DecodingStrategy, greedy, sampling
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.processor import Processor
from openvima.policies.t5 import tokenizer_for
from openvima.policies.tokenizer import Tokenizer
from openvima.scene import RenderedPrompt

NEAR_TIE = 1e-4  # scores of two classes this near may change places by rounding in float32


@dataclass(frozen=True, slots=True, eq=False)
class _Episodes:
    """The episodes of a batch that still run; all have made equally many steps.

    Args:
        places: Where in the batch each one stands.
        num_slots: Their numbers of slots for objects, see `Processor.encode_observations`.
        generators: Generators of their draws.
        prompt: Their encoded prompts.
        state: Their decoding state.
        actions_BC: Their last actions, metres and quaternions, float32; None before the first.
        margins_B: How far the best class of their last action lay above the next, in its tightest choice;
            None before the first.
        features: Features of the images of the last step, or of the prompts, by digest.
    """

    places: tuple[int, ...]
    num_slots: tuple[int, ...]
    generators: tuple[torch.Generator, ...]
    prompt: Any  # the model's own record
    state: Any  # likewise
    actions_BC: torch.Tensor | None
    margins_B: torch.Tensor | None
    features: Mapping[bytes, torch.Tensor]

    def at(self, places: Sequence[int]) -> "_Episodes":
        """Return those that stand at some places of the batch."""
        rows = [self.places.index(place) for place in places]
        if len(rows) == len(self.places):
            return self
        return _Episodes(
            tuple(places),
            tuple(self.num_slots[row] for row in rows),
            tuple(self.generators[row] for row in rows),
            self.prompt.select(rows),
            self.state.select(rows),
            None if self.actions_BC is None else self.actions_BC[rows],
            None if self.margins_B is None else self.margins_B[rows],
            self.features,
        )


class NetworkPolicy(Policy):
    """Plays several episodes at once; what the others do does not change an episode's actions.

    The prompt is encoded once, and keys and values of all that was read are kept, so that a step costs what
    its own tokens cost. On a CPU it computes in float64 by default: the rounding of sums,
    which varies with the shape of a batch, then stays far below the float32 in which actions are sent, and
    the same episode gets the same actions in any batch. In float32 and bfloat16 that holds but for near ties.
    Large networks are several times faster in float32 and bfloat16.

    An error in `reset` or `act` leaves the policy as it was before the call.

    Args:
        network: The network; it is moved to the device and precision, and set to evaluation.
        tokenizer: Splits the text of prompts; by default the closed vocabulary, for networks made for that.
        extractor: Finds the objects in images; by default by the simulator's segmentation.
        device: Where to compute, such as "cpu" or "cuda".
        dtype: Precision; by default float64 on a CPU and float32 elsewhere.
        temperature: 0 takes the likeliest action. Above 0 actions are drawn, with scores divided by it.
        generator: Needed to draw. Its seed and the prompt decide an episode's draws, so that they do not
            depend on the other episodes; the generator itself is left as it is.

    Raises:
        PolicyError: The temperature is negative, or above 0 without a generator; no tokenizer is given to a
            network that reads prompts with that of T5; or there is no such device.
    """

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
        if temperature < 0 or (temperature > 0 and generator is None):
            raise PolicyError(
                f"temperature is {temperature:g}; it must be 0, or above 0 with a generator to draw with."
            )
        tokenizer = tokenizer or tokenizer_for(network.config.prompt)
        self.processor = Processor.of(network.config.inputs, tokenizer, extractor)
        self.device = usable_device(device)
        self.dtype = dtype or (torch.float64 if self.device.type == "cpu" else torch.float32)
        self.network = network.to(self.device, self.dtype).eval()
        if self.device.type == "cpu":
            # Crops are convolved with their channels together; kernels in another order would be copied at
            # every call, a third of what a few crops cost.
            self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._temperature = temperature
        self._seed = generator.initial_seed() if generator else 0
        self._num_prompts = 0
        self._episodes: _Episodes | None = None

    @torch.inference_mode()
    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Begin a batch of episodes.

        Raises:
            PolicyError: There is no prompt, or one is too long.
            PromptError: A prompt is empty, a word is unknown, or placeholders and images do not match.
            ShapeError: An image has another shape or dtype.
        """
        if not prompts:
            raise PolicyError("reset got no prompts; give one for each episode.")
        batch, stack = self.processor.encode_prompts(prompts)
        features_KF, features = self._encode(stack, {})
        prompt = self.network.encode_prompt(batch.to(self.device), features_KF)
        seeds = [(self._seed ^ prompt_number(prompt)) & (2**63 - 1) for prompt in prompts]
        self._episodes = _Episodes(
            places=tuple(range(len(prompts))),
            num_slots=(0,) * len(prompts),
            generators=tuple(torch.Generator().manual_seed(seed) for seed in seeds),
            prompt=prompt,
            state=self.network.init_cache(prompt),
            actions_BC=None,
            margins_B=None,
            features=features,
        )
        self._num_prompts = len(prompts)

    @torch.inference_mode()
    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        """Decide the next action of every episode.

        Args:
            observations: One for each prompt; None for an episode that has ended, from then on.

        Returns:
            An action for each observation, float32 arrays within the bounds; None for None.

        Raises:
            PolicyError: `reset` was not called, or with another number of prompts; an episode goes on after
                its end; no object is in view; or a history is too long.
            ShapeError: An image has another shape or dtype.
        """
        if self._episodes is None:
            raise PolicyError("there are no prompts yet; call reset with one for each episode first.")
        if len(observations) != self._num_prompts:
            raise PolicyError(
                f"got {len(observations)} observations for {self._num_prompts} prompts; give one for each, "
                "and None for episodes that have ended."
            )
        seen = {
            place: observation for place, observation in enumerate(observations) if observation is not None
        }
        ended = sorted(seen.keys() - self._episodes.places)
        if ended:
            raise PolicyError(
                f"episode {', '.join(map(str, ended))} ended with a None before; call reset to begin anew."
            )
        episodes = self._episodes.at(list(seen))
        actions: list[dict[str, np.ndarray] | None] = [None] * len(observations)
        if seen:
            episodes = self._decide(episodes, list(seen.values()))
            assert episodes.actions_BC is not None
            arrays_BC = episodes.actions_BC.cpu().numpy()
            for place, array_C in zip(seen, arrays_BC, strict=True):
                actions[place] = {key: array_C[part].copy() for key, part in ACTION_PARTS.items()}
        self._episodes = episodes
        return actions

    def new_session(self) -> "NetworkPolicy":
        """Return a policy that shares the network with this one and has episodes of its own."""
        other = copy(self)
        other._num_prompts, other._episodes = 0, None  # never changed in place, so nothing else is shared
        return other

    @property
    def near_ties(self) -> list[bool]:
        """For each episode whether rounding may have chosen its last action; False where it has ended.

        It may where two classes scored within `NEAR_TIE` of each other.
        """
        near = [False] * self._num_prompts
        if self._episodes is not None and self._episodes.margins_B is not None:
            margins = self._episodes.margins_B.tolist()
            for place, margin in zip(self._episodes.places, margins, strict=True):
                near[place] = margin < NEAR_TIE
        return near

    @staticmethod
    def from_pretrained(
        path_or_hub_id: str | Path,
        **options: Any,  # Any: of several kinds
    ) -> "NetworkPolicy":
        """Load a policy from a folder or from the Hugging Face Hub; see `load_pretrained`."""
        from openvima.policies.checkpoint import load_pretrained

        return load_pretrained(path_or_hub_id, **options)

    def save_pretrained(self, folder: str | Path, *, dtype: torch.dtype = torch.float32) -> None:
        """Write the policy into a folder; see `openvima.policies.checkpoint.save_checkpoint`.

        Args:
            folder: Where to; a checkpoint that is there is replaced.
            dtype: Precision of the stored weights, whatever the policy computes in.
        """
        from openvima.policies.checkpoint import save_pretrained

        save_pretrained(self, folder, dtype=dtype)

    def _decide(self, episodes: _Episodes, observations: Sequence[Mapping]) -> _Episodes:
        """Make one step of all episodes."""
        batch, stack = self.processor.encode_observations(
            [[observation] for observation in observations], episodes.num_slots
        )
        features_KF, features = self._encode(stack, episodes.features)
        history = batch.to(self.device)
        has_previous_B1 = torch.full_like(history.steps_BT, episodes.actions_BC is not None)
        previous_BC = episodes.actions_BC
        if previous_BC is None:
            previous_BC = torch.zeros(len(observations), ACTION_WIDTH, device=self.device)
        strategy = sampling(episodes.generators, self._temperature) if self._temperature else greedy
        margins: list[torch.Tensor] = []
        actions_B1C, state = self.network.decode_step(
            episodes.prompt,
            episodes.state,
            history,
            features_KF,
            previous_BC[:, None],
            has_previous_B1,
            _recording_margins(strategy, margins),
        )
        return replace(
            episodes,
            num_slots=tuple(batch.num_slots_BT[:, 0].tolist()),
            state=state,
            actions_BC=actions_B1C[:, 0].to(torch.float32),  # the history holds actions as they are sent
            margins_B=torch.stack(margins).amin(0) if margins else None,
            features=features,
        )

    def _encode(
        self, stack: ImageStack, known: Mapping[bytes, torch.Tensor]
    ) -> tuple[torch.Tensor, dict[bytes, torch.Tensor]]:
        """Encode the images that are new; most objects look as they did a step ago.

        Returns:
            Features of all images, and by digest.
        """
        images, keys = stack.images(), stack.digests()
        new = [number for number, key in enumerate(keys) if key not in known]
        encoded = self.network.encode_images(torch.from_numpy(images[new]).to(self.device))
        if len(new) == len(keys):
            return encoded, dict(zip(keys, encoded, strict=True))
        by_key = {**known, **dict(zip((keys[number] for number in new), encoded, strict=True))}
        features = torch.stack([by_key[key] for key in keys])
        return features, dict(zip(keys, features, strict=True))


def _recording_margins(strategy: DecodingStrategy, margins: list[torch.Tensor]) -> DecodingStrategy:
    """Decode likewise, and record by how much the best class of each row leads, shape (B,)."""

    def recorded(logits: torch.Tensor) -> torch.Tensor:
        if logits.shape[-1] > 1:
            best, second = logits.topk(2).values.unbind(-1)
            margins.append((best - second).flatten(1).amin(1))
        return strategy(logits)

    return recorded
