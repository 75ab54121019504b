"""A network as a policy: keeps what it has read of a batch of episodes and decides each step."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from openvima.errors import PolicyError
from openvima.policies.base import Policy, prompt_number
from openvima.policies.heads.base import ACTION_PARTS, ACTION_WIDTH, Choose, likeliest
from openvima.policies.inputs import (
    EpisodeReader,
    ImageStack,
    Reader,
    StepInput,
    batch_histories,
    batch_prompts,
)
from openvima.policies.layers.trunk import TrunkState
from openvima.policies.network import Memory, PolicyNetwork
from openvima.policies.perception import GROUND_TRUTH, ObjectFinder
from openvima.policies.t5 import tokenizer_for
from openvima.policies.tokenizer import Tokenizer
from openvima.scene import RenderedPrompt

_FORGOTTEN = -1  # row of an episode that has ended


class NetworkPolicy(Policy):
    """Plays several episodes at once; what the others do does not change an episode's actions.

    The prompt is encoded once, and keys and values of all that was read are kept, so that a step costs what
    its own tokens cost. On a processor it computes in float64 unless told otherwise: the rounding of sums,
    which varies with the shape of a batch, then stays far below the float32 in which actions are sent, and
    the same episode gets the same actions in any batch. In float32 and bfloat16 that holds but for near ties.

    Args:
        network: The network; it is moved to the device and precision, and set to evaluation.
        tokenizer: Splits the text of prompts; by default the closed vocabulary, for networks made for that.
        finder: Finds the objects in images; by default by the simulator's segmentation.
        device: Where to compute, such as "cpu" or "cuda".
        dtype: Precision; by default float64 on a processor and float32 elsewhere.
        temperature: 0 takes the likeliest action. Above 0 actions are drawn, with scores divided by it.
        generator: Needed to draw. Its seed and the prompt decide an episode's draws, so that they do not
            depend on the other episodes; the generator itself is left as it is.

    Raises:
        PolicyError: The temperature is negative, or above 0 without a generator; or no tokenizer is given to
            a network that reads prompts with that of T5.
    """

    def __init__(
        self,
        network: PolicyNetwork,
        *,
        tokenizer: Tokenizer | None = None,
        finder: ObjectFinder = GROUND_TRUTH,
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
        self.reader = Reader.of(network.config.images, tokenizer, finder)
        self.device = torch.device(device)
        self.dtype = dtype or (torch.float64 if self.device.type == "cpu" else torch.float32)
        self.network = network.to(self.device, self.dtype).eval()
        self._temperature = temperature
        self._seed = generator.initial_seed() if generator else 0
        self._memory: Memory | None = None
        self._state: TrunkState | None = None
        self._rows: list[int] = []  # of each episode in memory and state
        self._episodes: list[EpisodeReader] = []
        self._generators: list[torch.Generator] = []
        self._previous = torch.zeros(0, ACTION_WIDTH, dtype=torch.float64)  # one row an episode
        self._started: list[bool] = []

    @torch.inference_mode()
    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Begin a batch of episodes.

        Raises:
            PolicyError: There is no prompt, or one is too long.
            PromptError: A prompt is empty, a word is unknown, or placeholders and images do not match.
        """
        if not prompts:
            raise PolicyError("reset got no prompts; give one for each episode.")
        inputs = [self.reader.read_prompt(prompt) for prompt in prompts]
        stack = ImageStack(self.reader.image_size)
        numbers = [stack.add(prompt.objects.crops) for prompt in inputs]
        features = self._encode(stack.stacked())
        batch = batch_prompts(inputs, numbers).to(self.device)
        self._memory = self.network.encode_prompts(batch, features)
        self._state = self.network.begin(self._memory)
        self._rows = list(range(len(prompts)))
        self._episodes = [self.reader.begin_episode() for _ in prompts]
        self._generators = [
            torch.Generator().manual_seed((self._seed ^ prompt_number(prompt)) & (2**63 - 1))
            for prompt in prompts
        ]
        self._previous = torch.zeros(len(prompts), ACTION_WIDTH, dtype=torch.float64)
        self._started = [False] * len(prompts)

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
        """
        if self._memory is None or len(observations) != len(self._rows):
            raise PolicyError(
                f"got {len(observations)} observations for {len(self._rows)} prompts; call reset with one "
                "prompt for each episode first, and pass None for those that have ended."
            )
        active = [row for row, observation in enumerate(observations) if observation is not None]
        actions: list[dict[str, np.ndarray] | None] = [None] * len(observations)
        steps = [self._see(row, observations[row]) for row in active]
        self._keep(active)
        if not active:
            return actions
        for row, action in zip(active, self._decide(active, steps), strict=True):
            self._previous[row], self._started[row] = action, True
            values = action.to(torch.float32).numpy()
            actions[row] = {key: values[part].copy() for key, part in ACTION_PARTS.items()}
        return actions

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

    def _see(self, row: int, observation: Mapping | None) -> StepInput:
        assert observation is not None
        if self._rows[row] == _FORGOTTEN:
            raise PolicyError(f"episode {row} ended with a None before; call reset to begin new episodes.")
        return self._episodes[row].read_step(observation)

    def _keep(self, active: Sequence[int]) -> None:
        """Forget the episodes that have ended."""
        assert self._memory is not None
        assert self._state is not None
        rows = [self._rows[row] for row in active]
        if len(rows) == len(self._memory.mask_BL):
            return
        self._memory, self._state = self._memory.select(rows), self._state.select(rows)
        self._rows = [_FORGOTTEN] * len(self._rows)
        for place, row in enumerate(active):
            self._rows[row] = place

    def _decide(self, active: Sequence[int], steps: Sequence[StepInput]) -> torch.Tensor:
        """Return the actions of the active episodes, shape (episodes, 12)."""
        assert self._memory is not None
        assert self._state is not None
        stack = ImageStack(self.reader.image_size)
        numbers = [[stack.add(step.objects.crops)] for step in steps]
        features = self._encode(stack.stacked())
        history = batch_histories([[step] for step in steps], numbers).to(self.device)
        previous_B1C = self._previous[active][:, None].to(self.device)
        started_B1 = torch.tensor([[self._started[row]] for row in active], device=self.device)
        inputs, self._state = self.network.extend(
            self._memory, self._state, history, features, previous_B1C, started_B1
        )
        generators = [self._generators[row] for row in active]
        choose = _drawing(generators, self._temperature) if self._temperature else likeliest
        return self.network.head.decide(inputs, choose)[:, 0].to("cpu", torch.float64)

    def _encode(self, images: np.ndarray) -> torch.Tensor:
        return self.network.encode_images(torch.from_numpy(images).to(self.device))


def _drawing(generators: Sequence[torch.Generator], temperature: float) -> Choose:
    def draw(scores: torch.Tensor) -> torch.Tensor:
        chances = torch.softmax(scores.to("cpu", torch.float64) / temperature, dim=-1)
        drawn = [
            torch.multinomial(row.flatten(0, -2), 1, generator=generator).view(row.shape[:-1])
            for row, generator in zip(chances, generators, strict=True)
        ]
        return torch.stack(drawn).to(scores.device)

    return draw
