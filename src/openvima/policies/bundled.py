"""Trained policies that come with the package, each under a name of its own."""

from dataclasses import dataclass
from pathlib import Path

from openvima.errors import CheckpointError, PolicyError
from openvima.policies.file_names import CHECKPOINTS_FOLDER, CONFIG_FILE, WEIGHTS_FILE

SMALL = "openvima-small"
MODEL_CARD = "MODEL_CARD.md"

_TRAINED = Path(__file__).parent / "trained"


@dataclass(frozen=True, slots=True)
class PackagedPolicy:
    """A trained policy of the package.

    Args:
        folder: Its checkpoint folder, with the model card beside the weights.
        trained_on: What it was trained on, in one line.
    """

    folder: Path
    trained_on: str

    @property
    def model_card(self) -> Path:
        """Where its data, training, scores, weak tasks and limits are told."""
        return self.folder / MODEL_CARD

    @property
    def weights(self) -> Path:
        """File of the weights; an installation may lack it."""
        return self.folder / WEIGHTS_FILE

    @property
    def is_here(self) -> bool:
        """Whether weights and sizes are part of this installation."""
        return self.weights.is_file() and (self.folder / CONFIG_FILE).is_file()


PACKAGED: dict[str, PackagedPolicy] = {
    SMALL: PackagedPolicy(_TRAINED / SMALL, "demonstrations of the 13 training tasks, training partition"),
}


def packaged_folder(name: str) -> Path:
    """Return the checkpoint folder of a trained policy of the package.

    Args:
        name: One of `PACKAGED`.

    Raises:
        PolicyError: A folder here has that name and holds a checkpoint, too.
        CheckpointError: This installation holds no weights of it.
    """
    # Other folders may bear the name, as after `evaluate --policy openvima-small --out openvima-small`.
    if any((Path(name) / part).exists() for part in (WEIGHTS_FILE, CHECKPOINTS_FOLDER)):
        raise PolicyError(
            f"{name!r} is a trained policy of the package, and a folder with another one here; write "
            f"./{name} for the folder, or work elsewhere for that of the package."
        )
    policy = PACKAGED[name]
    if not policy.is_here:
        raise CheckpointError(
            f"this installation lacks the weights of {name!r}, which belong into {policy.folder}; install "
            "openvima again, or give a run folder."
        )
    return policy.folder
