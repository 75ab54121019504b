"""Where checkpoints come from: local folders and files, bundled checkpoints, the Hugging Face Hub."""

from collections.abc import Sequence
from pathlib import Path

from openvima.atomic_io import restore_folder
from openvima.errors import CheckpointError, unknown_name
from openvima.hub import HubName, fetch, hub_name
from openvima.input_files import as_path, read_text
from openvima.policies.bundled import BUNDLED, bundled_folder
from openvima.policies.file_names import (
    BEST_FILE,
    CHECKPOINTS_FOLDER,
    CONFIG_FILE,
    TOKENIZER_FOLDER,
    WEIGHTS_FILE,
    checkpoint_order,
)
from openvima.policies.presets import PRESETS, PUBLISHED, UNTRAINED, is_untrained
from openvima.user_code import is_code

_HUB_FILES = (WEIGHTS_FILE, CONFIG_FILE, f"{TOKENIZER_FOLDER}/*")


def is_policy_source(text: str) -> bool:
    """Whether a text names a bundled checkpoint, an existing path or a repository on the Hub."""
    return text in BUNDLED or Path(text).exists() or hub_name(text) is not None


def is_own_code(text: str) -> bool:
    """Whether a text names a function that makes a policy, and no existing path; or a file without one."""
    if is_untrained(text):
        return False
    return text.endswith(".py") or (is_code(text) and not Path(text).exists())


def unknown_policy(name: str, others: Sequence[str]) -> str:
    """Compose the message for an unknown policy.

    Args:
        name: The name as given; that of a preset has no weights.
        others: Allowed names besides bundled checkpoints; where they are none, presets are allowed, too.
    """
    if name in PRESETS:
        return f"{_without_weights(name)} {UNTRAINED}:{name} has random ones."
    named = (*others, *BUNDLED)
    presets = f"{UNTRAINED}:PRESET for a preset" if others else "a preset"
    hint = (
        f"Allowed: {', '.join(named)}, {presets} that `openvima policies` lists, the folder of a training "
        "run, a published .ckpt file, owner/name or owner/name@revision on the Hugging Face Hub, "
        "FILE.py:FUNCTION, MODULE:FUNCTION, or in evaluations ws://HOST:PORT or lerobot:PATH."
    )
    return unknown_name("policy", name, (*named, *PRESETS), hint)


def _without_weights(preset: str) -> str:
    """Compose the message for a preset where weights are expected: how to get some."""
    architecture, _, size = preset.rpartition("-")
    needs_t5 = architecture in PUBLISHED and size != "nano"
    t5 = " --t5 t5-base" if needs_t5 else ""
    elsewhere = ", or see docs/policies.md for the published weights" if t5 and architecture == "vima" else ""
    return (
        f"{preset!r} is a preset: sizes of a network, without weights. Train it (`openvima train --preset "
        f"{preset}{t5} --data DEMOS --out RUN`) and name the folder RUN, or name a bundled checkpoint "
        f"({', '.join(BUNDLED)}){elsewhere}."
    )


def find_checkpoint(path_or_hub_id: str | Path) -> Path:
    """Resolve a path, a name or a Hub id to a checkpoint folder or a published file.

    Args:
        path_or_hub_id: A run folder, a checkpoint folder, a file, the name of a bundled checkpoint (as text;
            a `Path` is always a local path), or the name of a repository on the Hub such as
            "owner/policy@v1", which is downloaded.

    Raises:
        CheckpointError: There is no such path, it is the name of a preset, or the installation lacks the
            weights.
        HubError: The download failed.
        PolicyError: A local folder has the name of a bundled checkpoint and holds a checkpoint, too.
        MissingExtraError: The Hub's client is needed and not installed.
    """
    if isinstance(path_or_hub_id, str) and path_or_hub_id in BUNDLED:
        return bundled_folder(path_or_hub_id)
    path, name = as_path(path_or_hub_id), str(path_or_hub_id)
    restore_folder(path)
    if path.is_dir():
        return checkpoint_folder(path)
    if path.exists():
        return path
    if repository := hub_name(name):
        return fetch(repository, _HUB_FILES)
    if name in PRESETS:
        raise CheckpointError(_without_weights(name))
    raise CheckpointError(
        f"there is no checkpoint at {name}; give a folder, a .ckpt file, owner/name[@revision] or "
        f"{', '.join(BUNDLED)}."
    )


def hub_commit(source: str) -> str | None:
    """Return the repository and commit of a policy on the Hub, as "owner/name@commit"; None for any other.

    Raises:
        HubError: The download failed.
    """
    name = None if source in BUNDLED else hub_name(source)
    return None if name is None else str(HubName(name.repo, find_checkpoint(source).name))


def checkpoint_folder(folder: Path) -> Path:
    """Return the folder itself, or the best, else the latest, checkpoint of a run folder."""
    checkpoints = folder / CHECKPOINTS_FOLDER
    if not checkpoints.is_dir():
        return folder
    best = checkpoints / BEST_FILE
    if best.is_file():
        named = checkpoints / Path(read_text(best).strip()).name  # never a folder elsewhere
        if named.is_dir():
            return named
    found = (path for path in checkpoints.iterdir() if path.is_dir() and not path.suffix)
    return max(found, key=checkpoint_order, default=folder)
