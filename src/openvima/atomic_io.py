"""Files and folders that bear their name only once they are whole."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """Open a file to be written under a temporary name; it gets its own when the block ends well.

    After an exception nothing is left, after a crash a hidden `.tmp` file. The folder must exist.

    Args:
        path: Final name; a file that bears it is replaced in one move.

    Yields:
        The file, open for writing bytes.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def atomic_write_file(path: Path, content: bytes | str) -> Path:
    """Write a file so that it is either the old one or the whole new one, whatever happens.

    Args:
        path: The file; missing folders are made.
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
    """Fill a folder under a temporary name; it gets its own when the block ends well.

    After an exception nothing is left, after a crash a hidden `.tmp` folder. A folder that bears the name is
    moved aside before and deleted after. Should the process die between, `restore_folder` puts it back.

    Args:
        path: Final name; missing parents are made.

    Yields:
        The folder to fill.
    """
    path = path.resolve()  # what a link leads to
    restore_folder(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    try:
        yield temporary
        _sync_files(temporary)
        aside = _aside(path)
        if path.exists():
            shutil.rmtree(aside, ignore_errors=True)
            os.replace(path, aside)
        os.replace(temporary, path)
        _sync_folder(path.parent)
        shutil.rmtree(aside, ignore_errors=True)
    finally:
        restore_folder(path)
        shutil.rmtree(temporary, ignore_errors=True)


def restore_folder(path: Path) -> None:
    """Put back a folder that was moved aside to be replaced, if its replacement never came."""
    path = path.resolve()
    aside = _aside(path)
    if not path.exists() and aside.is_dir():
        os.replace(aside, path)


def remove_stale(folder: Path) -> None:
    """Delete what writers have left in a folder that were killed; those that still run keep their files.

    Where the system does not tell which processes run, nothing is deleted.
    """
    if os.name != "posix":
        return
    for file in folder.glob(".*.tmp"):
        process = file.name.split(".")[-2]
        if process.isdecimal() and not _runs(int(process)):
            file.unlink(missing_ok=True)


def _runs(process_id: int) -> bool:
    try:
        os.kill(process_id, 0)  # sends nothing
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # it is somebody else's
        return True
    return True


def _aside(path: Path) -> Path:
    return path.with_name(f".{path.name}.old")


def _sync_files(folder: Path) -> None:
    for file in folder.rglob("*"):
        if file.is_file():
            with open(file, "rb+") as stream:
                os.fsync(stream.fileno())


def _sync_folder(folder: Path) -> None:
    """Make a rename last through a power cut, where the system can."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
