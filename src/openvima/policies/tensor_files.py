"""Files of tensors. Reading those of others is bounded in time and memory, and executes nothing."""

import hashlib
import os
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Collection, Container, Mapping, Sequence
from pathlib import Path
from reprlib import repr as short
from typing import Any, BinaryIO

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from openvima.atomic_io import FREE_SPACE
from openvima.errors import CheckpointError, InputFileError, StorageError, echo
from openvima.input_files import open_regular
from openvima.pickle_opcodes import OPCODES, check_opcodes

_MAX_HEADER_BYTES = 8 * 2**20  # names and shapes of about 80,000 tensors; VIMA-200M has 700
_MAX_PICKLE_BYTES = 4 * 2**20  # of an archive, without the tensors; that of VIMA-200M has 0.1 MB
_MAX_OPERATIONS = 1_000_000
_MAX_DIRECTORY_BYTES = 16 * 2**20
_MAX_SHARED = 4  # bytes of all tensors, in bytes of the file: tensors may share their storage
_MAX_LISTED = 5  # names that a message lists
_MAX_REASON = 200  # characters
_OPCODES = (OPCODES | {"BINPERSID"}) - {"STACK_GLOBAL"}
_GLOBALS = re.compile(
    r"collections OrderedDict|torch\._utils _rebuild_(tensor_v2|parameter)|torch(\.storage)? \w+Storage"
)
_SYSTEM_ERROR = re.compile(r"\(os error (\d+)\)")  # in messages of safetensors
# Layouts from the specification of the format (APPNOTE 6.3.9): end record, and its 64-bit form before a
# pointer of 20 bytes to that.
_END, _END_64, _POINTER_64_BYTES = struct.Struct("<4s4H2LH"), struct.Struct("<4sQ2H2L4Q"), 20
_LONGEST_COMMENT = 0xFFFF


def read_safetensors(file: Path) -> dict[str, torch.Tensor]:
    """Read a safetensors file; tensors are memory-mapped.

    Raises:
        CheckpointError: It is missing, damaged, or holds weights that are not finite.
    """
    try:
        with open_regular(file) as stream:
            size = int.from_bytes(stream.read(8), "little")
        if size > _MAX_HEADER_BYTES:
            raise InputFileError(f"its header has {size} bytes, more than {_MAX_HEADER_BYTES}")
        tensors = load_file(file)
    except MemoryError:
        raise
    except Exception as error:  # a malicious file can fail in any way
        raise CheckpointError(f"{file} is damaged ({_reason(error)}). Take another checkpoint.") from error
    check_finite(tensors, file)
    return tensors


def read_archive(file: Path, *, classes: Collection[type] = ()) -> Any:
    """Read an archive of tensors and plain values, as `torch.save` writes it.

    Args:
        file: The archive.
        classes: Further classes that it may name, and call without arguments.

    Raises:
        OSError: The file cannot be read.
        InputFileError: It is damaged, would execute code, or would take more memory than its size explains.
            The message begins with the file.
    """
    named = {f"{kind.__module__} {kind.__qualname__}" for kind in classes}
    with open_regular(file) as stream:
        try:
            _check_archive(stream, named)
            num_bytes = stream.seek(0, 2)
            stream.seek(0)
            with torch.serialization.safe_globals([*classes]):
                values = torch.load(stream, map_location="cpu", weights_only=True)
            _check_sizes(values, num_bytes)
        except MemoryError:
            raise
        except InputFileError as error:
            raise InputFileError(f"{file} {error}") from None
        except Exception as error:  # a malicious file can fail in any way
            reason = f"{type(error).__name__}: {_reason(error)}"
            raise InputFileError(f"{file} is a zip archive, but no torch checkpoint ({reason}).") from error
    return values


def write_safetensors(tensors: Mapping[str, torch.Tensor], file: Path) -> None:
    """Write a safetensors file, readable for whoever the umask allows; safetensors makes it private.

    Raises:
        OSError: It cannot be written, for example because the disk is full.
    """
    try:
        with file.open("wb") as stream:
            mode = stat.S_IMODE(os.fstat(stream.fileno()).st_mode)
        save_file(dict(tensors), file)
        file.chmod(mode)
    except SafetensorError as error:
        if found := _SYSTEM_ERROR.search(str(error)):
            raise OSError(int(found[1]), os.strerror(int(found[1])), str(file)) from error
        raise StorageError(f"{file} cannot be written ({_reason(error)}). {FREE_SPACE}") from error


def file_digest(file: Path) -> str:
    """Return the SHA-256 of a file's content, as hexadecimal text."""
    with open_regular(file) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_finite(tensors: Mapping[str, torch.Tensor], file: Path) -> None:
    """Refuse weights that are NaN or infinite.

    Raises:
        CheckpointError: Some are; the message names them.
    """
    found = [
        name
        for name, tensor in tensors.items()
        if tensor.is_floating_point()
        and tensor.numel()
        and not all(bound.isfinite() for bound in torch.aminmax(_comparable(tensor)))
    ]
    if found:
        raise CheckpointError(
            f"{file}: {listed('weights that are not finite', found, limit=_MAX_LISTED)[0]}. The training "
            "diverged, or the file is damaged; take another checkpoint."
        )


def _comparable(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.float() if tensor.element_size() == 1 else tensor  # 8-bit floats cannot be compared


def _check_archive(stream: BinaryIO, classes: Container[str]) -> None:
    """Check that an archive is whole, that its entries are stored, and what its pickles would do."""
    if not _directory_bytes(stream) <= _MAX_DIRECTORY_BYTES:
        raise InputFileError(f"has a zip directory of more than {_MAX_DIRECTORY_BYTES} bytes.")
    try:
        with zipfile.ZipFile(stream) as archive:
            _check_entries(archive.infolist(), stream.seek(0, 2))
            damaged = archive.testzip()
            if damaged is not None:
                raise InputFileError(f"is damaged (in its entry {short(damaged)}). Download it again.")
            for entry in archive.infolist():
                if entry.filename.lower().endswith(".pkl"):
                    _check_pickle(archive.read(entry), classes)
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, OSError) as error:
        raise InputFileError(f"is damaged ({_reason(error)}). Download it again.") from error


def _directory_bytes(stream: BinaryIO) -> int:
    """Return the size of the directory of a zip archive, before anything reads it."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - _LONGEST_COMMENT - _END.size - _POINTER_64_BYTES - _END_64.size))
    tail = stream.read()
    at = tail.rfind(b"PK\5\6")
    if at < 0 or at + _END.size > len(tail):
        stream.seek(0)
        if stream.read(4) == b"PK\3\4":
            raise InputFileError("ends too early (interrupted download?). Download it again.")
        raise InputFileError("is no torch zip archive, as torch.save writes it since version 1.6.")
    if tail[at - _POINTER_64_BYTES : at].startswith(b"PK\6\7") and at >= _POINTER_64_BYTES + _END_64.size:
        return _END_64.unpack_from(tail, at - _POINTER_64_BYTES - _END_64.size)[-2]
    return _END.unpack_from(tail, at)[5]


def _check_entries(entries: Sequence[zipfile.ZipInfo], num_bytes: int) -> None:
    """Refuse compressed, overlapping and ambiguous entries; those of torch are none of that."""
    packed = [e.filename for e in entries if e.compress_type != zipfile.ZIP_STORED or e.flag_bits & 1]
    if packed or any(entry.compress_size != entry.file_size for entry in entries):
        raise InputFileError("is a compressed zip archive; those of torch are not. Nothing was unpacked.")
    if sum(entry.file_size for entry in entries) > num_bytes:
        raise InputFileError("has overlapping zip entries; those of torch lie one after the other.")
    if len({entry.filename.lower() for entry in entries}) < len(entries):
        raise InputFileError("has several zip entries of one name.")


def _check_pickle(content: bytes, classes: Container[str]) -> None:
    """Check what a pickle would load, and how much."""
    if len(content) > _MAX_PICKLE_BYTES:
        raise InputFileError(
            f"holds {len(content)} bytes besides its tensors; at most {_MAX_PICKLE_BYTES} are read."
        )
    if not content.startswith(b"\x80\2"):
        raise InputFileError("has a pickle of another protocol than 2, which torch writes.")
    try:
        names = check_opcodes(content, max_operations=_MAX_OPERATIONS, opcodes=_OPCODES)
    except InputFileError as error:
        raise InputFileError(f"cannot be read: {error}") from None
    unsafe = sorted(name for name in names if not _GLOBALS.fullmatch(name) and name not in classes)
    if unsafe:
        name = unsafe[0].replace(" ", ".")[:_MAX_REASON]
        raise InputFileError(
            f"wants {name} to be loaded, which could execute code. Nothing was executed. Such files hold "
            "nothing but tensors and numbers; take it from where it is published."
        )


def _check_sizes(values: Any, num_bytes: int) -> None:
    """Refuse tensors that are larger than their storage, which would grow when they are copied."""
    total, level = 0, [values]
    while level:
        value = level.pop()
        if isinstance(value, Mapping):
            level += value.values()
        elif isinstance(value, list | tuple):
            level += value
        elif isinstance(value, torch.Tensor):
            own = value.numel() * value.element_size()
            total += own
            if own > value.untyped_storage().nbytes() or total > _MAX_SHARED * num_bytes:
                raise InputFileError(
                    f"has tensors that repeat their numbers, such as one of shape {tuple(value.shape)}; save "
                    "them in full."
                )


def _reason(error: Exception) -> str:
    """One line about an error."""
    return " ".join(str(error).split())[:_MAX_REASON].rstrip(".") or type(error).__name__


def listed(what: str, names: Sequence[str], *, limit: int) -> list[str]:
    """Return ["what: first, second and 3 more"], or an empty list without names."""
    if not names:
        return []
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return [f"{what}: {', '.join(map(echo, names[:limit]))}{more}"]


def described(dtype: torch.dtype, shape: Sequence[int] | None = None) -> str:
    """Format a dtype, and a shape if given, such as "float32 (768, 4)"."""
    name = str(dtype).removeprefix("torch.")
    return name if shape is None else f"{name} {tuple(shape)}"
