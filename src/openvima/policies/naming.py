"""Names of policies: what a text stands for, the bundled checkpoints, and files and folders of others."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from openvima.atomic_io import restore_folder
from openvima.errors import InputFileError, PolicyError, unknown_name
from openvima.hub import HubName, fetch, hub_name
from openvima.input_files import as_path, as_text, read_text
from openvima.policies.presets import PRESETS, check_preset
from openvima.user_code import is_code

WEIGHTS_FILE = "model.safetensors"
CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.jsonl"  # in the folder of a run
TOKENIZER_FOLDER = "tokenizer"
CHECKPOINTS_FOLDER = "checkpoints"
BEST_FILE = "best.txt"  # in the checkpoints folder; contains the name of the best one


def checkpoint_order(checkpoint: Path) -> tuple[str, int]:
    """Return a sort key of checkpoints: stage, then step, which may have more digits than the name pads."""
    stage, _, step = checkpoint.name.rpartition("-")
    return stage, int(step) if step.isdigit() else -1


SMALL = "openvima-small"
VIMA = "openvima-vima"
MODEL_CARD = "MODEL_CARD.md"

ORACLE, RANDOM, UNTRAINED = "oracle", "random", "untrained"
LEROBOT = "lerobot:"  # begins the names of LeRobot policies
VLM = "vlm:"  # begins the names of models of a chat server
SERVER_SCHEMES = ("ws://", "wss://")
Kind = Literal[
    "oracle", "random", "untrained", "remote", "lerobot", "vlm", "code", "bundled", "path", "hub", "unknown"
]

# Folders of the bundled checkpoints, with the model card beside the weights.
BUNDLED: dict[str, Path] = {name: Path(__file__).parent / "trained" / name for name in (SMALL, VIMA)}


def bundled_folder(name: str) -> Path:
    """Return the folder of a bundled checkpoint.

    Args:
        name: One of `BUNDLED`.

    Raises:
        PolicyError: A local folder has that name and holds a checkpoint, too.
    """
    # A folder without a checkpoint may have the name, as after
    # `evaluate --policy openvima-small --out openvima-small`.
    if any((Path(name) / part).exists() for part in (WEIGHTS_FILE, CHECKPOINTS_FOLDER)):
        raise PolicyError(
            f"{name!r} is a bundled checkpoint, and also a local folder with a checkpoint; write ./{name} "
            "for the folder, or run in another directory for the bundled one."
        )
    return BUNDLED[name]


_HUB_FILES = (WEIGHTS_FILE, CONFIG_FILE, f"{TOKENIZER_FOLDER}/*")


@dataclass(frozen=True, slots=True)
class PolicyRef:
    """What a text names as a policy. Nothing is loaded, asked or downloaded.

    | kind | text |
    |---|---|
    | oracle | "oracle", in evaluations |
    | random | "random" |
    | untrained | "untrained", or "untrained:PRESET" |
    | remote | "ws://HOST:PORT" or "wss://…", in evaluations |
    | lerobot | "lerobot:PATH" or "lerobot:OWNER/NAME", in evaluations |
    | vlm | "vlm:MODEL", in evaluations |
    | code | "FILE.py:FUNCTION" or "MODULE:FUNCTION" |
    | bundled | name of a bundled checkpoint |
    | path | an existing run folder, checkpoint folder or published .ckpt file |
    | hub | "owner/name" or "owner/name@revision" on the Hugging Face Hub |
    | unknown | anything else, such as a preset, which has no weights |

    Args:
        text: The text.
        kind: As above.
    """

    text: str
    kind: Kind

    @staticmethod
    def parse(source: str | Path) -> "PolicyRef":
        """Read a name; a `Path` is always a local one."""
        text = as_text(source)
        return PolicyRef(text, _kind(text))

    @property
    def has_weights(self) -> bool:
        """Whether it names a checkpoint, see `find_checkpoint`."""
        return self.kind in ("bundled", "path", "hub")

    @property
    def model(self) -> str:
        """Name of a vision-language model on its server.

        Raises:
            PolicyError: It is empty.
        """
        name = self.text.removeprefix(VLM)
        if not name:
            raise PolicyError("vlm: lacks the name of a model; write vlm:MODEL, with its name on the server.")
        return name

    @property
    def preset(self) -> str:
        """The preset whose fresh weights an untrained policy has.

        Raises:
            UnknownPolicyError: There is no such preset.
        """
        name = self.text.partition(":")[2] if ":" in self.text else "nano"
        check_preset(name)
        return name


def _kind(text: str) -> Kind:
    if text in (ORACLE, RANDOM):
        return text
    if text.startswith(LEROBOT):
        return "lerobot"
    if text.startswith(VLM):
        return "vlm"
    if text.startswith(SERVER_SCHEMES):
        return "remote"
    if text.partition(":")[0] == UNTRAINED:
        return "untrained"
    if text.endswith(".py") or (is_code(text) and not Path(text).exists()):  # a file alone lacks its function
        return "code"
    if text in BUNDLED:
        return "bundled"
    if Path(text).exists():
        return "path"
    return "hub" if hub_name(text) else "unknown"


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
        "FILE.py:FUNCTION, MODULE:FUNCTION, or in evaluations ws://HOST:PORT, lerobot:PATH or vlm:MODEL."
    )
    return unknown_name("policy", name, (*named, *PRESETS), hint)


def _without_weights(preset: str) -> str:
    """Compose the message for a preset where weights are expected: how to get some."""
    return (
        f"{preset!r} is a preset: sizes of a network, without weights. Train it (`openvima train --preset "
        f"{preset} --data DEMOS --out RUN`) and name the folder RUN, or name a bundled checkpoint "
        f"({', '.join(BUNDLED)})."
    )


def find_checkpoint(path_or_hub_id: str | Path) -> Path:
    """Resolve a path, a name or a Hub id to a checkpoint folder or a published file.

    Args:
        path_or_hub_id: A run folder, a checkpoint folder, a file, the name of a bundled checkpoint (as text;
            a `Path` is always a local path), or the name of a repository on the Hub such as
            "owner/policy@v1", which is downloaded.

    Raises:
        InputFileError: There is no such path, or it is the name of a preset.
        ServerError: The download failed.
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
        raise InputFileError(_without_weights(name))
    raise InputFileError(
        f"there is no checkpoint at {name}; give a folder, a .ckpt file, owner/name[@revision] or "
        f"{', '.join(BUNDLED)}."
    )


def hub_commit(source: str) -> str | None:
    """Return the repository and commit of a policy on the Hub, as "owner/name@commit"; None for any other.

    Raises:
        ServerError: The download failed.
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
