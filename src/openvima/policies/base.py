"""The policy interface, the random policy, and where networks compute."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from openvima.errors import PolicyError, PromptError
from openvima.imports import import_extra
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Action, RenderedPrompt
from openvima.scene.prompt import PLACEHOLDER

if TYPE_CHECKING:
    import torch

POLICIES_THAT_EXPLAIN = (
    "Those that do: openvima-small, openvima-vima, and networks of all presets, unless their head was "
    "exchanged for mixture or regression."
)


class Policy(Protocol):
    """Anything that maps prompt and history to actions, for several episodes at once.

    Optional: `modalities` names what observations hold, as `TabletopEnv` takes it; evaluations provide that.
    `control` is "end_effector" where `act` returns commands of the tool, float32, shape (5,), as
    `TabletopEnv` takes them with that control; else "primitives". Evaluations with the other control refuse
    it.
    `explain()`, called after `act`, returns an `openvima.scene.explanation.Explanation` for each episode,
    None for those that have ended; `openvima demo --explain` draws them. Policy servers read two more:
    `new_session()` returns a policy with episodes of its own, and `prompt_limits` is its `PromptLimits`.
    """

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Start a batch of episodes, one prompt each."""
        ...

    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        """Decide the next action of every episode.

        Args:
            observations: One for each prompt: `ee`, and `rgb` and `segm` (view name to array) or what else
                `modalities` names. None for an episode that has ended.

        Returns:
            For each observation the four arrays of an action, float32, within bounds; None for None. An
            episode's actions must not depend on the other episodes of the batch.
        """
        ...


class RandomPolicy(Policy):
    """Samples pick and place positions and the rotation uniformly over the workspace.

    Each episode has its own generator, seeded from the policy's seed and the prompt.
    """

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed
        self._rngs: list[np.random.Generator] = []

    def new_session(self) -> "RandomPolicy":
        """Return a policy with the same seed and its own episodes."""
        return RandomPolicy(self.seed)

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Start a batch of episodes."""
        self._rngs = [
            np.random.default_rng(np.random.SeedSequence([self.seed, prompt_hash(prompt)]))
            for prompt in prompts
        ]

    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        """Sample an action for every running episode.

        Raises:
            PolicyError: `reset` was not called, or with another number of prompts.
        """
        if len(observations) != len(self._rngs):
            raise PolicyError(f"got {len(observations)} observations for {len(self._rngs)} prompts.")
        return [
            None if observation is None else _random_action(rng)
            for observation, rng in zip(observations, self._rngs, strict=True)
        ]


def require_torch(what: str) -> None:
    """Check that torch and safetensors can be imported.

    Args:
        what: What needs them.

    Raises:
        MissingExtraError: One is not installed; the message names the extra.
        MemoryError: They do not fit into memory.
    """
    for module in ("torch", "safetensors"):
        import_extra(module, f"{what} needs {module}; install it with: pip install 'openvima[train]'")


def prompt_hash(prompt: RenderedPrompt) -> int:
    """Hash the text and the images of a prompt to a 64-bit number."""
    digest = hashlib.blake2b(prompt.text.encode(), digest_size=8)
    for image in prompt.images.values():
        for view in sorted(image.rgb):
            digest.update(np.ascontiguousarray(image.rgb[view]).tobytes())
    return int.from_bytes(digest.digest(), "little")


def _random_action(rng: np.random.Generator) -> dict[str, np.ndarray]:
    (x0, y0), (x1, y1) = rng.uniform(WORKSPACE_LOW, WORKSPACE_HIGH, size=(2, 2)).tolist()
    return Action.planar((x0, y0), (x1, y1), float(rng.uniform(-np.pi, np.pi))).to_arrays()


@dataclass(frozen=True, slots=True)
class PromptLimits:
    """The largest prompt of a policy; a policy may state its own as `prompt_limits`.

    The prompts of the benchmark have up to 280 characters, 8 images and 20 objects.

    Args:
        chars: Characters of the text.
        images: Placeholders of the text, and images.
        objects: Objects of all images, hidden ones included.
    """

    chars: int = 4096
    images: int = 64
    objects: int = 256

    def check(self, prompt: RenderedPrompt) -> None:
        """Check a prompt.

        Raises:
            PromptError: It holds more than allowed; the message names the number.
        """
        found = {
            "chars": len(prompt.text),
            "images": max(len(prompt.images), len(PLACEHOLDER.findall(prompt.text))),
            "objects": sum(len(image.objects) for image in prompt.images.values()),
        }
        for name, number in found.items():
            if number > (allowed := getattr(self, name)):
                what = "characters" if name == "chars" else name
                raise PromptError(f"the prompt has {number:,} {what}; this policy takes {allowed:,}.")


def usable_device(device: "torch.device | str") -> "torch.device":
    """Return a device after checking that it works.

    For a GPU, cuDNN's attention is turned off in this process: it plans anew for each shape, and those of
    prompts and histories vary (`results/2026-11-26_gpu.md`).

    Raises:
        PolicyError: The device is not available.
    """
    import torch

    try:
        found = torch.device(device)
        torch.zeros(1, device=found).item()  # raises on "meta", too, whose tensors have no values
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise PolicyError(
            f"device {str(device)!r} cannot be used here; allowed: cpu, and cuda on a machine with a GPU for "
            "which torch is installed."
        ) from error
    if found.type == "cuda":
        torch.backends.cuda.enable_cudnn_sdp(False)
    return found


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set the number of threads; it changes the summation order, and so the last bits of results."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
