"""Atomic writes of files and folders."""

import contextlib
import errno
import glob
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

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
