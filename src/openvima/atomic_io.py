"""Atomic writes of files and folders, and one writer at a time in a folder."""

import contextlib
import errno
import glob
import json
import logging
import math
import os
import re
import shlex
import shutil
import socket
import stat
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO, TypeVar

from openvima.errors import ConfigError, FolderLockedError, StorageError

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
    """Let a library write a file under a temporary name, and rename it when the block succeeds.

    An exception leaves nothing, a crash a hidden `.tmp` file, which the next writer of that name deletes. The
    folder must exist.

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
            sync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


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
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    remove_stale(path.parent, path.name)
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        with naming(path, temporary):
            temporary.mkdir()
            yield temporary
            sync_files(temporary)
            backup = _backup_path(path)
            if path.exists():
                shutil.rmtree(backup, ignore_errors=True)
                os.replace(path, backup)
            os.replace(temporary, path)
            sync_folder(path.parent)
            shutil.rmtree(backup, ignore_errors=True)
    finally:
        restore_folder(path)
        shutil.rmtree(temporary, ignore_errors=True)


def restore_folder(path: Path) -> None:
    """Restore the backup of a folder whose replacement was never completed."""
    path = path.resolve()
    backup = _backup_path(path)
    if not path.exists() and backup.is_dir():
        os.replace(backup, path)


def remove_stale(folder: Path, name: str | None = None) -> None:
    """Delete the temporary files and folders that killed writers left in a folder; on POSIX systems only.

    Args:
        folder: The folder.
        name: Delete only those of this file or folder.
    """
    if os.name != "posix":
        return
    for path in folder.glob(".*.tmp" if name is None else f".{glob.escape(name)}.*.tmp"):
        process = path.name.split(".")[-2]
        if not process.isdecimal() or process_runs(int(process)):
            continue
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


def sync_file(file: Path) -> None:
    """Wait until the content of a file is on the disk."""
    with open(file, "rb+") as stream:
        os.fsync(stream.fileno())


def sync_files(folder: Path) -> None:
    """Wait until the content of all files below a folder is on the disk."""
    for file in folder.rglob("*"):
        if file.is_file():
            sync_file(file)


def sync_folder(folder: Path) -> None:
    """Make a rename durable, on POSIX systems."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK_NAME = ".lock"
HEARTBEAT_S = 5.0
HEARTBEATS_WATCHED = 3
FINISH_S = 600.0  # to wait for another process that finishes a folder of several writers
_POLL_S = 0.1
_MAX_TEXT = 120  # characters of a command that a message shows
_MAX_BYTES = 4096  # of an owner's file, which could be anything
_END = 1 << 62
_NO_OWNER = (  # errors of a file that names none
    OSError,
    ValueError,
    TypeError,
    LookupError,
    ArithmeticError,
    AttributeError,
    RecursionError,
)

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


@dataclass(frozen=True, slots=True)
class Owner:
    """An owner of a lock.

    Args:
        host: Name of the machine.
        process: Process id.
        command: Command line.
        since: When the lock was taken, in seconds since 1970.
        part: First and past-the-end number of the locked parts.
    """

    host: str
    process: int
    command: str
    since: float
    part: Part

    def __str__(self) -> str:
        minutes = max(0, round((time.time() - self.since) / 60))
        return f"process {self.process} on {self.host}, for {minutes} min (`{self.command}`)"


@contextlib.contextmanager
def folder_lock(folder: Path, part: Part | None = None, *, timeout_s: float = 0.0) -> Iterator[None]:
    """Hold the lock of a folder while the block runs.

    The lock on the whole folder also deletes the temporary files that killed writers left in it. A folder
    that the lock created is deleted if it is empty at the end.

    Args:
        folder: The folder; it is created if missing.
        part: First and past-the-end number of parts, such as shards; several processes can lock disjoint
            parts. None locks the whole folder.
        timeout_s: How long to wait for other writers.

    Raises:
        FolderLockedError: Another writer has the lock; the message names it.
        StorageError: The lock file is no regular file.
        OSError: The folder cannot be written to.
    """
    is_new = not folder.exists()
    path = folder.resolve() / LOCK_NAME
    own = Owner(_host(), os.getpid(), _command(), time.time(), part or (0, _END))
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            descriptor = _acquire(path, own)
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
    stop = threading.Event()
    threading.Thread(target=_beat, args=(_owner_file(path, own), stop), daemon=True).start()
    try:
        if part is None:
            remove_stale(folder)
        yield
    finally:
        stop.set()
        _release(path, own, descriptor)
        if is_new:
            with contextlib.suppress(OSError):  # it is not empty
                folder.rmdir()


def is_lock_file(path: Path) -> bool:
    """Whether a file belongs to a lock, perhaps one that was being taken, and not to the folder's content."""
    return path.name == LOCK_NAME or path.name.startswith((f"{LOCK_NAME}.", f".{LOCK_NAME}."))


def _acquire(path: Path, own: Owner) -> int:
    """Take a lock and return the descriptor of its file.

    Raises:
        FolderLockedError: Others have it; the message is their names.
    """
    with _GUARD:
        if path in _held:  # closing a second descriptor would release the lock
            raise FolderLockedError("another thread of this process")
        descriptor, is_locked = _locked_file(path, own.part)
        try:
            if is_locked is False:
                owners = [owner for _, owner in _others(path, own)]
                owners = [owner for owner in owners if owner.host != own.host or process_runs(owner.process)]
                raise FolderLockedError(" and ".join(map(str, owners)) or "another process")
            if owners := _alive(path, own, has_lock=bool(is_locked)):
                raise FolderLockedError(" and ".join(map(str, owners)))
        except BaseException:
            os.close(descriptor)
            raise
        _held.add(path)
    try:
        atomic_write_file(_owner_file(path, own), json.dumps(asdict(own)))
    except BaseException:
        _release(path, own, descriptor)
        raise
    return descriptor


def _release(path: Path, own: Owner, descriptor: int) -> None:
    if os.getpid() != own.process:  # a forked child
        return
    with _GUARD, contextlib.suppress(OSError):  # of a folder that is gone
        _held.discard(path)
        _owner_file(path, own).unlink(missing_ok=True)
        if _lock(descriptor, (0, _END)) is not False:  # nobody else has a part
            path.unlink(missing_ok=True)
    os.close(descriptor)


def _locked_file(path: Path, part: Part) -> tuple[int, bool | None]:
    """Open a lock file and lock a part of it, as `_lock` does."""
    while True:
        with contextlib.suppress(FileNotFoundError):
            # One look: between two, another process may delete the file that it created.
            if not stat.S_ISREG(os.lstat(path).st_mode):
                raise StorageError(f"{path} is no regular file, so the folder cannot be locked; delete it.")
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        except FileNotFoundError:  # another process deletes the folder that it created
            continue
        try:
            is_locked, mine = _lock(descriptor, part), os.fstat(descriptor)
            with contextlib.suppress(FileNotFoundError):
                if is_locked is False or os.path.samestat(mine, os.lstat(path)):
                    return descriptor, is_locked
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # its last owner deleted the file meanwhile


def _lock(descriptor: int, part: Part) -> bool | None:
    """Lock a part of a file; return whether it was free, and None where there are no record locks."""
    if fcntl is None:
        return None
    first, end = part
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, end - first, first)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        if error.errno in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
            return None
        raise
    return True


def _alive(path: Path, own: Owner, *, has_lock: bool) -> list[Owner]:
    """Return other owners that still run, and delete the files of those that do not."""
    others = _others(path, own)
    alive = [
        owner
        for _, owner in others
        if owner.host == own.host
        and owner.process != own.process
        and not has_lock
        and process_runs(owner.process)
    ]
    elsewhere = [(file, owner) for file, owner in others if owner.host != own.host]
    if elsewhere:
        before = [_touched(file) for file, _ in elsewhere]
        wait_s = HEARTBEATS_WATCHED * HEARTBEAT_S
        _LOGGER.warning("%s: waiting %.0f s to see whether %s ended", path, wait_s, elsewhere[0][1])
        time.sleep(wait_s)
        alive += [o for (file, o), at in zip(elsewhere, before, strict=True) if _touched(file) not in (at, 0)]
    for file, owner in others:
        if owner not in alive:
            file.unlink(missing_ok=True)
    return alive


def _others(path: Path, own: Owner) -> list[tuple[Path, Owner]]:
    """Return the owners of overlapping parts, each with its file."""
    found = []
    for file in sorted(path.parent.glob(f"{LOCK_NAME}.*")):
        with contextlib.suppress(*_NO_OWNER):
            if file.is_symlink() or not file.is_file() or file.stat().st_size > _MAX_BYTES:
                continue
            entry = json.loads(file.read_bytes())
            owner = Owner(
                _printable(entry["host"]),
                int(entry["process"]),
                _printable(entry["command"]),
                float(entry["since"]),
                (int(entry["part"][0]), int(entry["part"][1])),
            )
            if math.isfinite(owner.since) and owner.part[0] < own.part[1] and own.part[0] < owner.part[1]:
                found.append((file, owner))
    return found


def _beat(file: Path, stop: threading.Event) -> None:
    while not stop.wait(HEARTBEAT_S):
        with contextlib.suppress(OSError):
            os.utime(file)


def _touched(file: Path) -> int:
    """When a file was last touched, in nanoseconds; 0 if it is gone."""
    try:
        return file.stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def _owner_file(path: Path, owner: Owner) -> Path:
    return path.with_name(f"{LOCK_NAME}.{owner.host}.{owner.process}")


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:64] or "unknown"


def _command() -> str:
    return _printable(shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]))


def _printable(text: str) -> str:
    shown = "".join(letter if letter.isprintable() else "?" for letter in text)
    return shown if len(shown) <= _MAX_TEXT else shown[: _MAX_TEXT - 1] + "…"
