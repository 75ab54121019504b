"""Trained checkpoints bundled with the package, by name."""

from dataclasses import dataclass
from pathlib import Path

from openvima.errors import CheckpointError, PolicyError
from openvima.policies.file_names import CHECKPOINTS_FOLDER, CONFIG_FILE, WEIGHTS_FILE

SMALL = "openvima-small"
VIMA = "openvima-vima"
MODEL_CARD = "MODEL_CARD.md"

_TRAINED = Path(__file__).parent / "trained"


@dataclass(frozen=True, slots=True)
class BundledPolicy:
    """A bundled checkpoint.

    Args:
        folder: The checkpoint folder, with the model card beside the weights.
        trained_on: Training data, in one line.
    """

    folder: Path
    trained_on: str

    @property
    def model_card(self) -> Path:
        """Model card: data, training, scores, weak tasks and limitations."""
        return self.folder / MODEL_CARD

    @property
    def weights(self) -> Path:
        """Weights file; an installation may lack it."""
        return self.folder / WEIGHTS_FILE

    @property
    def is_installed(self) -> bool:
        """Whether this installation has weights and config."""
        return self.weights.is_file() and (self.folder / CONFIG_FILE).is_file()


BUNDLED: dict[str, BundledPolicy] = {
    SMALL: BundledPolicy(_TRAINED / SMALL, "demonstrations of the 13 training tasks, training partition"),
    VIMA: BundledPolicy(_TRAINED / VIMA, "demonstrations of the 13 training tasks, 30% rendered again"),
}


def bundled_folder(name: str) -> Path:
    """Return the folder of a bundled checkpoint.

    Args:
        name: One of `BUNDLED`.

    Raises:
        PolicyError: A local folder has that name and holds a checkpoint, too.
        CheckpointError: This installation lacks its weights.
    """
    # A folder without a checkpoint may have the name, as after
    # `evaluate --policy openvima-small --out openvima-small`.
    if any((Path(name) / part).exists() for part in (WEIGHTS_FILE, CHECKPOINTS_FOLDER)):
        raise PolicyError(
            f"{name!r} is a bundled checkpoint, and also a local folder with a checkpoint; write ./{name} "
            "for the folder, or run in another directory for the bundled one."
        )
    policy = BUNDLED[name]
    if not policy.is_installed:
        raise CheckpointError(
            f"this installation lacks the weights of {name!r}, which belong into {policy.folder}; "
            "reinstall openvima, or give a run folder."
        )
    return policy.folder
