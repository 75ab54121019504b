"""What a policy is, the policy that acts at random, and loading policies by name."""

import hashlib
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from openvima.errors import MissingExtraError, PolicyError, UnknownPolicyError, unknown_name
from openvima.policies.presets import PRESETS
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Action, RenderedPrompt

CHECKPOINTS_FOLDER = "checkpoints"
BEST_FILE = "best.txt"  # in the checkpoints folder: name of the best one


class Policy(Protocol):
    """Anything that maps prompt and history to actions, for several episodes at once."""

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Begin a batch of episodes, one prompt each."""
        ...

    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        """Decide the next action of every episode.

        Args:
            observations: One for each prompt: `rgb` and `segm` (view name to array) and `ee`. None for an
                episode that has ended.

        Returns:
            For each observation the four arrays of an action, float32, within bounds; None for None. What the
            other episodes of the batch do must not change it.
        """
        ...

    @staticmethod
    def from_pretrained(path_or_hub_id: str | Path, **options: Any) -> "Policy":  # Any: of several kinds
        """Load a network's policy from a folder or the Hugging Face Hub; see `load_pretrained`.

        A helper for convenience, which a policy of your own need not have.
        """
        require_torch("loading a policy")
        from openvima.policies.checkpoint import load_pretrained

        return load_pretrained(path_or_hub_id, **options)


class RandomPolicy(Policy):
    """Picks and places anywhere on the table, turned by any angle.

    Each episode draws from a generator of its own, which follows from the seed and the prompt alone.
    """

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed
        self._rngs: list[np.random.Generator] = []

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Begin a batch of episodes."""
        self._rngs = [
            np.random.default_rng(np.random.SeedSequence([self.seed, prompt_number(prompt)]))
            for prompt in prompts
        ]

    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        """Draw an action for every episode that has not ended.

        Raises:
            PolicyError: `reset` was not called, or with another number of prompts.
        """
        if len(observations) != len(self._rngs):
            raise PolicyError(f"got {len(observations)} observations for {len(self._rngs)} prompts.")
        return [
            None if observation is None else _random_action(rng)
            for observation, rng in zip(observations, self._rngs, strict=True)
        ]


def load_policy(name_or_run: str, *, seed: int = 0) -> Policy:
    """Load a policy by name or from a folder.

    Args:
        name_or_run: "random"; "untrained" or the name of a preset, for fresh weights; or a run folder or
            checkpoint folder that `openvima train` wrote. Of a run folder the best checkpoint is taken.
        seed: Seed of the random policy's draws and of fresh weights.

    Returns:
        The policy, ready for `reset`.

    Raises:
        UnknownPolicyError: It is neither a name nor a folder.
        CheckpointError: The folder holds no checkpoint that can be read.
        MissingExtraError: The policy needs torch, which is not installed.
    """
    if name_or_run == "random":
        return RandomPolicy(seed)
    if name_or_run == "untrained" or name_or_run in PRESETS:
        require_torch(f"policy {name_or_run!r}")
        from openvima.policies.acting import NetworkPolicy
        from openvima.policies.network import build_network
        from openvima.policies.presets import preset

        config = preset("nano" if name_or_run == "untrained" else name_or_run)
        return NetworkPolicy(build_network(config, seed=seed))
    if not Path(name_or_run).is_dir():
        known = ("random", "untrained", *PRESETS)
        raise UnknownPolicyError(
            unknown_name(
                "policy", name_or_run, known, "Give a run folder or one that `openvima policies` lists."
            )
        )
    require_torch(f"the policy in {name_or_run}")
    from openvima.policies.checkpoint import load_pretrained

    return load_pretrained(name_or_run)


def checkpoint_folder(folder: Path) -> Path:
    """Find the checkpoint to use: the folder itself, or the best or else the latest one of a run folder."""
    checkpoints = folder / CHECKPOINTS_FOLDER
    if not checkpoints.is_dir():
        return folder
    best = checkpoints / BEST_FILE
    if best.is_file():
        named = checkpoints / best.read_text(encoding="utf-8").strip()
        if named.is_dir():
            return named
    found = sorted(path for path in checkpoints.iterdir() if path.is_dir() and not path.suffix)
    return found[-1] if found else folder


def require_torch(what: str) -> None:
    """Raise a MissingExtraError that names the extra if torch or safetensors cannot be imported."""
    for module in ("torch", "safetensors"):
        try:
            import_module(module)
        except ImportError as error:
            raise MissingExtraError(
                f"{what} needs {module}; install it with: pip install 'openvima[train]'"
            ) from error


def prompt_number(prompt: RenderedPrompt) -> int:
    """A number that follows from the content of a prompt."""
    digest = hashlib.blake2b(prompt.text.encode(), digest_size=8)
    for image in prompt.images.values():
        for view in sorted(image.rgb):
            digest.update(np.ascontiguousarray(image.rgb[view]).tobytes())
    return int.from_bytes(digest.digest(), "little")


def _random_action(rng: np.random.Generator) -> dict[str, np.ndarray]:
    (x0, y0), (x1, y1) = rng.uniform(WORKSPACE_LOW, WORKSPACE_HIGH, size=(2, 2)).tolist()
    return Action.planar((x0, y0), (x1, y1), float(rng.uniform(-np.pi, np.pi))).to_arrays()
