"""Names that differ between the published files and this package, and names that neither knows."""

import hashlib
from typing import Literal

from openvima.catalog import OBJECTS
from openvima.errors import MemberError, unknown_name
from openvima.tasks import list_tasks

Split = Literal["train", "validation"]

# Folder names of the published files and of older ones, and what the tasks are called today.
OLD_TASK_NAMES = {
    "simple_manipulation": "visual_manipulation",
    "same_profile": "same_shape",
    "same_color": "same_texture",
    "sweep": "sweep_without_exceeding",
}
# The authors advise 600,000 episodes for training and 50,000 for validation, but list neither.
_NUM_FOLDS = 13


def todays_task(folder_name: str) -> str | None:
    """Return the name of the task whose episodes a folder holds; None if there is no such task."""
    name = OLD_TASK_NAMES.get(folder_name, folder_name)
    return name if name in list_tasks() else None


def checked_object(name: object) -> str:
    """Return an object's display name, which is the same here and there.

    Raises:
        MemberError: The catalogue has no such object.
    """
    if not isinstance(name, str) or name not in OBJECTS:
        shown = name[:60] if isinstance(name, str) else type(name).__name__
        raise MemberError(unknown_name("object", shown, OBJECTS, "`openvima assets info` lists them."))
    return name


def split_of(task: str, episode_id: str) -> Split:
    """Tell whether an episode is for training or for validation, 12 to 1 and always the same.

    Args:
        task: Today's name of the task.
        episode_id: Name of the episode's folder, such as "000123".
    """
    digest = hashlib.sha256(f"{task}/{int(episode_id):06d}".encode()).digest()
    return "validation" if int.from_bytes(digest[:8], "big") % _NUM_FOLDS == 0 else "train"
