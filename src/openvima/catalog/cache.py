"""Disk cache of decoded and procedural arrays."""

import io
import logging
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from openvima.atomic_io import atomic_write
from openvima.input_files import cache_dir

_logger = logging.getLogger(__name__)

_CHECKSUM_BYTES = 4  # CRC-32 of all before it; at the end of a file, where readers of .npy ignore it


def cached_array(group: str, key: str, build: Callable[[], np.ndarray]) -> np.ndarray:
    """Read an array from the cache, or build and store it.

    A damaged file is replaced. Without write access the array is built each time.

    Args:
        group: Folder in the cache, with the kind and version of its files.
        key: File name without extension, unique in the group.
        build: Builds the array.
    """
    path = cache_dir() / group / f"{key}.npy"
    try:
        return _read(path)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError, EOFError) as error:
        _logger.warning("%s cannot be read (%s); it will be rebuilt", path, error)
    array = build()
    try:
        _write(path, array)
    except OSError as error:
        _logger.info("%s was not cached: %s", path, error)
    return array


def _read(path: Path) -> np.ndarray:
    content = path.read_bytes()
    body, checksum = content[:-_CHECKSUM_BYTES], content[-_CHECKSUM_BYTES:]
    if zlib.crc32(body).to_bytes(_CHECKSUM_BYTES, "little") != checksum:
        raise ValueError("its checksum is wrong")
    return np.load(io.BytesIO(body), allow_pickle=False)


def _write(path: Path, array: np.ndarray) -> None:
    """Write atomically, with a checksum."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    body = buffer.getvalue()
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        file.write(body)
        file.write(zlib.crc32(body).to_bytes(_CHECKSUM_BYTES, "little"))
