"""What the files of one episode are called, and how large they may be."""

import hashlib
import io
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path

from openvima.data.shard import map_file
from openvima.errors import DatasetError

PICKLES = ("obs.pkl", "action.pkl", "trajectory.pkl")
FRAME_FOLDERS = ("rgb_front", "rgb_top")
# An episode of 30 steps with eight prompt images has 4 MB; larger claims are damage or malice.
MAX_EPISODE_BYTES = 64 * 2**20
_FRAME = re.compile(rf"({'|'.join(FRAME_FOLDERS)})/[0-9]{{1,6}}\.jpg")


def is_episode_file(name: str) -> bool:
    """Whether an episode needs a file; the name is relative to its folder."""
    return name in PICKLES or _FRAME.fullmatch(name) is not None


MAX_DEPTH = 3  # folders above those of the tasks


class EpisodeFolders:
    """Folders `…/TASK/ID/` on the disk.

    Args:
        path: A folder above those of the tasks, or that of one task.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def episodes(self) -> dict[str, str]:
        """The folders of all episodes, such as "vima_v6/rotate/000123", and their paths.

        The disk is searched once; what comes later is not seen.
        """
        found = {}
        for folder, names, _ in os.walk(self.path, followlinks=True):
            below = Path(folder).relative_to(self.path)
            # For a task's own folder the name of the task is not part of the relative path.
            shown = below.as_posix() if below.parts else self.path.resolve().name
            numbered = [name for name in names if name.isascii() and name.isdigit()]
            found |= {f"{shown}/{name}": os.path.join(folder, name) for name in numbered}
            is_task = numbered or len(below.parts) == MAX_DEPTH
            names[:] = [] if is_task else sorted(name for name in names if not name.startswith("."))
        return found

    def digest(self) -> str:
        """Return 32 hexadecimal digits for the names of all episodes; to read all files would take hours."""
        names = "\n".join(sorted(self.episodes))
        return hashlib.sha256(names.encode("utf-8", "surrogateescape")).hexdigest()[:32]

    def files(self, place: str) -> Mapping[str, bytes]:
        """Read the files of an episode.

        Args:
            place: As `episodes` gives it.

        Returns:
            Path within the episode's folder, such as "rgb_top/0.jpg", to content.

        Raises:
            DatasetError: A file cannot be read, or all are too large.
            OSError: The folder cannot be read.
        """
        episode, contents, num_left = Path(place), {}, MAX_EPISODE_BYTES
        for path in sorted([*episode.iterdir(), *episode.glob("*/*")]):
            name = path.relative_to(episode).as_posix()
            if not (is_episode_file(name) and path.is_file()):
                continue
            try:
                with open(path, "rb") as stream:
                    contents[name] = stream.read(num_left + 1)
            except OSError as error:
                raise DatasetError(f"{name} cannot be read: {error.strerror}.") from None
            num_left -= len(contents[name])
            if num_left < 0:
                raise DatasetError(
                    f"it has more than the {MAX_EPISODE_BYTES:,} bytes that episodes have at most."
                )
        return contents


# Layouts from the specification of the format (APPNOTE 6.3.9): end record, its 64-bit form and the pointer to
# that, and what a directory's entry has before its name.
_END = struct.Struct("<4s4H2LH")
_END_64 = struct.Struct("<4sQ2H2L4Q")
_POINTER_64 = struct.Struct("<4sLQL")
_ENTRY_BYTES, _LENGTHS_AT = 46, 28
_LENGTHS = struct.Struct("<3H")  # of name, extra fields and comment
_LONGEST_END = _END_64.size + _POINTER_64.size + _END.size + 0xFFFF  # the last is that of a comment
_MAX_TEXT = 200  # characters of a reason
# What the standard library raises for damaged archives, and for members that it cannot read.
_DAMAGE_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError, OSError, ValueError),
    ArithmeticError,
)

_EPISODE = re.compile(rb"(?!__MACOSX/)(.*/)?([^/]+)/(\d+)/")

# Byte ranges of the directory with an episode's entries; nearly always one.
Place = tuple[tuple[int, int], ...]


class _Excerpt(io.RawIOBase):
    """An archive in whose directory are the entries of one episode; those of all would take gigabytes.

    Args:
        members: The archive up to its directory.
        entries: Those of the episode.
    """

    def __init__(self, members: memoryview, entries: bytes) -> None:
        size, start = len(entries), len(members)
        self._members, self._place = members, 0
        self._tail = (
            entries
            + _END_64.pack(b"PK\6\6", _END_64.size - 12, 45, 45, 0, 0, 0, 0, size, start)
            + _POINTER_64.pack(b"PK\6\7", 0, start + size, 1)
            + _END.pack(b"PK\5\6", 0, 0, 0, 0, 0, 0, 0)
        )

    def seekable(self) -> bool:
        """Whether it can be read in any order."""
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to a place and return it."""
        self._place = (0, self._place, len(self._members) + len(self._tail))[whence] + offset
        return self._place

    def read(self, size: int = -1) -> bytes:
        """Read at most so many bytes; -1: all."""
        source, place = self._members, self._place
        if place >= len(source):
            source, place = self._tail, place - len(source)
        content = bytes(source[place:] if size < 0 else source[place : place + size])
        self._place += len(content)
        return content


class ZipArchive:
    """A zip archive that holds episodes in folders `…/TASK/ID/`.

    Args:
        path: The file.

    Raises:
        DatasetError: It is no whole zip archive.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._content = path, map_file(path)
        self._start, self._end = _find_directory(self._content, path)

    @property
    def episodes(self) -> dict[str, Place]:
        """The folders of all episodes, such as "vima_v6/rotate/000123", and where their entries are.

        Raises:
            DatasetError: The directory is damaged.
        """
        places: dict[bytes, list[tuple[int, int]]] = {}
        for folder, start, end in self._runs():
            places.setdefault(folder, []).append((start, end))
        return {
            folder.decode("utf-8", "replace").rstrip("/"): tuple(ranges) for folder, ranges in places.items()
        }

    def digest(self) -> str:
        """Return 32 hexadecimal digits for the archive's directory, so for all names, sizes and checksums."""
        return hashlib.sha256(self._content[self._start : self._end]).hexdigest()[:32]

    def files(self, place: Place) -> Mapping[str, bytes]:
        """Read the files of an episode.

        Args:
            place: As `episodes` gives it.

        Returns:
            Path within the episode's folder, such as "rgb_top/0.jpg", to content.

        Raises:
            DatasetError: A member is damaged, too large or beyond the end.
        """
        entries = b"".join(self._content[start:end] for start, end in place)
        try:
            archive = zipfile.ZipFile(_Excerpt(self._content[: self._start], entries))
        except _DAMAGE_ERRORS as error:
            raise DatasetError(f"the archive's directory is damaged here ({error}).") from None
        members = {_EPISODE.sub(b"", m.filename.encode()).decode(): m for m in archive.infolist()}
        members = {name: member for name, member in members.items() if is_episode_file(name)}
        total = sum(max(member.file_size, member.compress_size) for member in members.values())
        if total > MAX_EPISODE_BYTES:
            raise DatasetError(f"it claims {total:,} bytes; episodes have at most {MAX_EPISODE_BYTES:,}.")
        contents = {}
        for name, member in members.items():
            try:
                contents[name] = archive.read(member)
            except _DAMAGE_ERRORS as error:
                raise DatasetError(f"{name} cannot be read: {str(error)[:_MAX_TEXT]}.") from None
        return contents

    def _runs(self) -> Iterator[tuple[bytes, int, int]]:
        """Folder, start and end of each run of entries that lie in the same episode's folder."""
        content, folder, run_start, position = self._content, None, self._start, self._start
        while position < self._end:
            try:
                name, extra, comment = _LENGTHS.unpack_from(content, position + _LENGTHS_AT)
            except struct.error:
                break  # beyond the end of the file
            name_start = position + _ENTRY_BYTES
            if folder is None or bytes(content[name_start : name_start + len(folder)]) != folder:
                if folder is not None:
                    yield folder, run_start, position
                match = _EPISODE.match(content[name_start : name_start + name])
                folder, run_start = match and match.group(), position
            position = name_start + name + extra + comment
        if position != self._end:
            raise DatasetError(f"{self.path}: its directory is damaged; copy or download it again.")
        if folder is not None:
            yield folder, run_start, position


def _find_directory(content: memoryview, path: Path) -> tuple[int, int]:
    """Start and end of the directory."""
    tail_start = max(0, len(content) - _LONGEST_END)
    tail = bytes(content[tail_start:])
    end = tail.rfind(b"PK\5\6")
    if end < 0 or end + _END.size > len(tail):
        raise DatasetError(f"{path} is no zip archive, or its end is missing (an interrupted download?).")
    *_, num_bytes, offset, _ = _END.unpack_from(tail, end)
    pointer = end - _POINTER_64.size
    if pointer >= 0 and tail.startswith(b"PK\6\7", pointer):
        end = pointer - _END_64.size  # the 64-bit end record lies right before the pointer to it
        if end < 0 or not tail.startswith(b"PK\6\6", end):
            raise DatasetError(f"{path}: its end record is damaged.")
        *_, num_bytes, offset = _END_64.unpack_from(tail, end)
    end += tail_start
    if offset != end - num_bytes:
        raise DatasetError(f"{path} lacks bytes before its directory; copy or download it again.")
    return offset, end
