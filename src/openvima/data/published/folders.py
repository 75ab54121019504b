"""Episodes in unpacked folders."""

import hashlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from openvima.data.published.layout import FRAME_FOLDERS, MAX_EPISODE_BYTES, is_episode_file
from openvima.errors import DatasetError, MemberError

MAX_DEPTH = 3  # folders above those of the tasks


class EpisodeFolders:
    """Folders `…/TASK/ID/` on the disk.

    Args:
        path: A folder above those of the tasks, or that of one task.

    Raises:
        DatasetError: There is no such folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_dir():
            raise DatasetError(f"there is no folder {path}.")
        self._episodes: dict[str, str] | None = None

    def episodes(self) -> Mapping[str, str]:
        """Return the folders of all episodes, such as "vima_v6/rotate/000123", and their paths.

        The disk is searched once; what comes later is not seen.
        """
        if self._episodes is None:
            self._episodes = self._found()
        return self._episodes

    def _found(self) -> dict[str, str]:
        found = {}
        for folder, names in _task_folders(self.path, MAX_DEPTH):
            # For a task's own folder the name of the task is not part of the relative path.
            shown = folder.relative_to(self.path).as_posix() if folder != self.path else folder.resolve().name
            for name in names:
                found[f"{shown}/{name}"] = str(folder / name)
        return found

    def digest(self) -> str:
        """Return 32 hexadecimal digits for the names of all episodes; to read all files would take hours."""
        names = "\n".join(sorted(self.episodes()))
        return hashlib.sha256(names.encode("utf-8", "surrogateescape")).hexdigest()[:32]

    def files(self, place: str) -> Mapping[str, bytes]:
        """Read the files of an episode.

        Args:
            place: As `episodes` gives it.

        Returns:
            Path within the episode's folder, such as "rgb_top/0.jpg", to content.

        Raises:
            MemberError: A file cannot be read, or all are too large.
        """
        contents, num_left = {}, MAX_EPISODE_BYTES
        for name in _files(Path(place)):
            try:
                with open(Path(place, name), "rb") as stream:
                    contents[name] = stream.read(num_left + 1)
            except OSError as error:
                raise MemberError(f"{name} cannot be read: {error.strerror}.") from None
            num_left -= len(contents[name])
            if num_left < 0:
                raise MemberError(
                    f"it has more than the {MAX_EPISODE_BYTES:,} bytes that episodes have at most."
                )
        return contents


def _files(episode: Path) -> list[str]:
    """The episode's files that exist, relative to its folder."""
    names = [entry.name for entry in os.scandir(episode) if entry.is_file()]
    for folder in FRAME_FOLDERS:
        if (episode / folder).is_dir():
            names += [f"{folder}/{entry.name}" for entry in os.scandir(episode / folder) if entry.is_file()]
    return sorted(filter(is_episode_file, names))


def _task_folders(folder: Path, depth: int) -> Iterator[tuple[Path, list[str]]]:
    """Folders that hold numbered ones, in the order of their names, and the names of those."""
    if names := _numbered(folder):
        yield folder, names
    elif depth > 0:
        for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
            if entry.is_dir() and not entry.name.startswith("."):
                yield from _task_folders(folder / entry.name, depth - 1)


def _numbered(folder: Path) -> list[str]:
    with os.scandir(folder) as entries:
        return [e.name for e in entries if e.name.isascii() and e.name.isdigit() and e.is_dir()]
