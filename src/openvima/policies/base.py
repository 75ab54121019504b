"""What a policy is, the policy that acts at random, and loading policies by name."""

import hashlib
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from openvima.atomic_io import restore_folder
from openvima.errors import (
    CheckpointError,
    MissingExtraError,
    PolicyError,
    UnknownPolicyError,
    unknown_name,
)
from openvima.policies.bundled import PACKAGED, packaged_folder
from openvima.policies.file_names import (
    BEST_FILE,
    CHECKPOINTS_FOLDER,
    CONFIG_FILE,
    TOKENIZER_FOLDER,
    WEIGHTS_FILE,
)
from openvima.policies.hub import fetch_from_hub, is_hub_id
from openvima.policies.presets import PRESETS
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Action, RenderedPrompt


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
        """Load a network's policy from a folder, a file or the Hugging Face Hub; see `load_pretrained`.

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

    def new_session(self) -> "RandomPolicy":
        """Return a policy that draws as this one does and has episodes of its own."""
        return RandomPolicy(self.seed)

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


def load_policy(name_or_run: str, *, seed: int = 0, **options: Any) -> Policy:  # Any: of several kinds
    """Load a policy by name, from a folder or file, or from the Hugging Face Hub.

    Args:
        name_or_run: "random"; "untrained" or the name of a preset, for fresh weights; "openvima-small", the
            trained policy of the package; a run folder that `openvima train` wrote, of which the best
            checkpoint is taken; a checkpoint folder; a published `.ckpt` file; or an id on the Hub such as
            "owner/policy".
        seed: Seed of the random policy's draws and of fresh weights.
        **options: Of `NetworkPolicy`, such as `tokenizer`, `device` or `dtype`. The random policy has none
            and leaves them aside.

    Returns:
        The policy, ready for `reset`.

    Raises:
        UnknownPolicyError: It is neither a name, nor a folder or file, nor like an id on the Hub.
        CheckpointError: The folder or file holds no checkpoint that can be read, or the Hub does not give it.
        PolicyError: The policy reads prompts with the tokenizer of T5, which is neither stored nor given; or
            a folder here is named like the preset, or holds a checkpoint and is named like the policy of the
            package.
        MissingExtraError: The policy needs torch, or the Hub's client, which is not installed.
    """
    if name_or_run == "random":
        return RandomPolicy(seed)
    if name_or_run == "untrained" or name_or_run in PRESETS:
        if Path(name_or_run).is_dir():
            raise PolicyError(
                f"{name_or_run!r} is a preset, with fresh weights, and a folder here; write ./{name_or_run} "
                "for the folder, or work elsewhere for the preset."
            )
        require_torch(f"policy {name_or_run!r}")
        from openvima.policies.build import build_network
        from openvima.policies.inference import NetworkPolicy
        from openvima.policies.presets import preset

        config = preset("nano" if name_or_run == "untrained" else name_or_run)
        return NetworkPolicy(build_network(config, seed=seed), **options)
    if not is_policy_source(name_or_run):
        raise UnknownPolicyError(unknown_policy(name_or_run, ("random", "untrained")))
    require_torch(f"the policy in {name_or_run}")
    from openvima.policies.checkpoint import load_pretrained

    return load_pretrained(name_or_run, **options)


def is_policy_source(text: str) -> bool:
    """Whether weights could lie there: a policy of the package, something here, or an id on the Hub."""
    return text in PACKAGED or Path(text).exists() or is_hub_id(text)


def unknown_policy(name: str, others: Sequence[str]) -> str:
    """Compose the message for something that names no policy.

    Args:
        name: It, as given.
        others: Names that are allowed besides those of trained policies and presets.
    """
    named = (*others, *PACKAGED)
    hint = (
        f"Allowed: {', '.join(named)}, a preset that `openvima policies` lists, the folder of a training "
        "run, a published .ckpt file, or an id owner/name on the Hugging Face Hub."
    )
    return unknown_name("policy", name, (*named, *PRESETS), hint)


def find_checkpoint(path_or_hub_id: str | Path) -> Path:
    """Find the checkpoint folder, or the published file, that a path, a name or an id on the Hub stands for.

    Args:
        path_or_hub_id: A run folder, a checkpoint folder, a file, a trained policy of the package (as text; a
            `Path` is always a place here), or an id such as "owner/policy"; what is not here but on the Hub
            is fetched.

    Raises:
        CheckpointError: There is no such path, the package lacks the weights, or the Hub does not give them.
        PolicyError: A folder here is named like a policy of the package and holds a checkpoint, too.
        MissingExtraError: The Hub's client is needed and not installed.
    """
    if isinstance(path_or_hub_id, str) and path_or_hub_id in PACKAGED:
        return packaged_folder(path_or_hub_id)
    path, name = Path(path_or_hub_id), str(path_or_hub_id)
    restore_folder(path)
    if path.is_dir():
        return checkpoint_folder(path)
    if path.exists():
        return path
    if is_hub_id(name):
        return fetch_from_hub(name, (WEIGHTS_FILE, CONFIG_FILE, f"{TOKENIZER_FOLDER}/*"))
    raise CheckpointError(
        f"there is no checkpoint at {name}; give a folder, a .ckpt file, an id owner/name or "
        f"{', '.join(PACKAGED)}."
    )


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
