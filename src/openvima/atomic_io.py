"""Atomic writes of files and folders, and one writer at a time in a folder."""

import contextlib
import errno
import fcntl
import logging
import os
import shutil
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, TypeVar

from openvima.errors import ConfigError, FolderLockedError

NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # how systems say that a disk is full
FREE_SPACE = "Free space, or give another folder; the same command then continues."


@contextlib.contextmanager
def naming(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Let errors of the system name a path that name none, such as a full disk, or the temporary one."""
    try:
        yield
    except OSError as error:
        names = (str(error.filename), str(error.filename2))  # of a copy the second is what is written
        is_temporary = temporary is not None and any(name.startswith(str(temporary)) for name in names)
        if not error.errno or (error.filename is not None and not is_temporary):
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error  # libraries add names


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Let a library write a file or folder under a temporary name, and rename it when the block succeeds.

    An exception leaves nothing, a crash a hidden `.tmp` file, which the next writer of that name deletes. The
    folder that it is in must exist.

    Args:
        path: Final name; an existing file is replaced atomically.

    Yields:
        The temporary name.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    remove_stale(path.parent, path.name)
    try:
        with naming(path, temporary):
            yield temporary
            sync_file(temporary)
            os.replace(temporary, path)
            sync_file(path.parent)
    finally:
        _remove(temporary)


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """Write a file as `atomic_path` does.

    Args:
        path: Final name; its folder must exist.

    Yields:
        The file, open for writing bytes.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        yield file


def atomic_write_file(path: Path, content: bytes | str) -> Path:
    """Write a whole file atomically.

    Args:
        path: The file; missing folders are created.
        content: Bytes, or text to be stored as UTF-8.

    Returns:
        The path.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)
    return path


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Fill a folder under a temporary name and rename it when the block succeeds.

    An exception leaves nothing, a crash a hidden `.tmp` folder. An existing folder is backed up first and
    deleted afterwards; if the process dies in between, `restore_folder` puts it back.

    Args:
        path: Final name; missing parents are created.

    Yields:
        The folder to fill.
    """
    path = path.resolve()  # follow links
    restore_folder(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    backup = _backup_path(path)
    try:
        with atomic_path(path) as temporary:
            _remove(temporary)
            temporary.mkdir()
            yield temporary
            sync_files(temporary)
            if path.exists():
                shutil.rmtree(backup, ignore_errors=True)
                os.replace(path, backup)
        shutil.rmtree(backup, ignore_errors=True)
    finally:
        restore_folder(path)


def restore_folder(path: Path) -> None:
    """Restore the backup of a folder whose replacement was never completed."""
    path = path.resolve()
    backup = _backup_path(path)
    if not path.exists() and backup.is_dir():
        os.replace(backup, path)


def remove_stale(folder: Path, name: str | None = None) -> None:
    """Delete the temporary files and folders that killed writers left in a folder.

    Args:
        folder: The folder.
        name: Delete only those of this file or folder.
    """
    start = "." if name is None else f".{name}."
    for found in os.listdir(folder):
        if found.startswith(start) and found.endswith(".tmp"):
            process = found.split(".")[-2]
            if process.isdecimal() and not process_runs(int(process)):
                _remove(folder / found)


def _remove(path: Path) -> None:
    """Delete a file or folder, if there is one and the system lets us."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def process_runs(process_id: int) -> bool:
    """Whether a process of this machine runs."""
    try:
        os.kill(process_id, 0)  # sends nothing
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's process
        pass
    return True


def _backup_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.old")


def sync_file(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_files(folder: Path) -> None:
    """Wait until the content of all files below a folder is on the disk."""
    for file in folder.rglob("*"):
        if file.is_file():
            sync_file(file)


LOCK_NAME = ".lock"
FINISH_S = 600.0  # to wait for another process that finishes a folder of several writers
_POLL_S = 0.1
_END = 1 << 62
_RECORD_LOCK = struct.Struct("hhqqi4x")  # `struct flock` of Linux: type, whence, start, length, process

Part = tuple[int, int]
T = TypeVar("T")
_LOGGER = logging.getLogger(__name__)
_GUARD = threading.Lock()
_held: set[Path] = set()  # by threads of this process, among which record locks make no difference


def parts_in_range(parts: Sequence[T], shard_range: Part) -> Sequence[T]:
    """Return the numbered parts of a folder that one of its writers has.

    Raises:
        ConfigError: The range lies beyond the last one.
    """
    start, stop = shard_range
    if start >= len(parts):
        raise ConfigError(
            f"shard_range is {start}:{stop}, but shards are numbered from 0 to {len(parts) - 1}."
        )
    return parts[start:stop]


@contextlib.contextmanager
def folder_lock(folder: Path, part: Part | None = None, *, timeout_s: float = 0.0) -> Iterator[None]:
    """Hold the lock of a folder while the block runs.

    The system releases the record lock of a process that is killed, and knows of those on other machines
    that share the file system. The lock on the whole folder also deletes the temporary files that killed
    writers left in it. A folder that the lock created is deleted if it is empty at the end.

    Args:
        folder: The folder; it is created if missing.
        part: First and past-the-end number of parts, such as shards; several processes can lock disjoint
            parts. None locks the whole folder.
        timeout_s: How long to wait for other writers.

    Raises:
        FolderLockedError: Another writer has the lock; the message names its process.
        OSError: The folder cannot be written to.
    """
    is_new, path, process = not folder.exists(), folder.resolve() / LOCK_NAME, os.getpid()
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            descriptor = _acquire(path, part or (0, _END))
            break
        except FolderLockedError as error:
            if time.monotonic() >= deadline:
                raise FolderLockedError(
                    f"{folder} is being written to by {error}. Wait for it, stop it, or give another folder."
                ) from None
            time.sleep(_POLL_S)
        except OSError as error:
            if error.errno != errno.EROFS:
                raise
            yield  # nobody can write to a read-only file system
            return
    try:
        if part is None:
            remove_stale(folder)
        yield
    finally:
        if os.getpid() == process:  # and not a forked child
            with _GUARD:
                _held.discard(path)
                # Another may have a part, or the folder is gone.
                with contextlib.suppress(FolderLockedError, OSError):
                    _lock(descriptor, (0, _END))
                    path.unlink()
                os.close(descriptor)
            if is_new:
                with contextlib.suppress(OSError):  # it is not empty
                    folder.rmdir()


def is_lock_file(path: Path) -> bool:
    """Whether a file belongs to a lock, and not to the folder's content."""
    return path.name == LOCK_NAME


def _acquire(path: Path, part: Part) -> int:
    """Take a lock and return the descriptor of its file.

    Raises:
        FolderLockedError: Another has it; the message is its name.
    """
    with _GUARD:
        if path in _held:  # closing a second descriptor would release the lock
            raise FolderLockedError("another thread of this process")
        while True:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            except FileNotFoundError:  # another process deletes the folder that it created
                continue
            try:
                _lock(descriptor, part)
                if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
                    _held.add(path)
                    return descriptor
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)  # its last owner deleted the file meanwhile


def _lock(descriptor: int, part: Part) -> None:
    """Lock a part of a file.

    Raises:
        FolderLockedError: Another process has it, or some of it.
    """
    start, length = part[0], part[1] - part[0]
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, length, start)
    except OSError as error:
        if error.errno in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
            _LOGGER.warning("this file system has no locks: nothing keeps others from writing to the folder")
        elif error.errno in (errno.EACCES, errno.EAGAIN):
            wanted = _RECORD_LOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, start, length, 0)
            *_, owner = _RECORD_LOCK.unpack(fcntl.fcntl(descriptor, fcntl.F_GETLK, wanted))
            raise FolderLockedError(f"process {owner}" if owner > 0 else "another process") from None
        else:
            raise
