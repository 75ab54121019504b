"""Files of tensors. Reading those of others executes nothing, and takes no more memory than their size."""

import hashlib
import pickle
import zipfile
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from openvima.errors import InputFileError, echo
from openvima.input_files import one_line, open_regular, read_yaml
from openvima.policies.naming import CONFIG_FILE

_MAX_LISTED = 5  # names that a message lists


def read_safetensors(file: Path) -> dict[str, torch.Tensor]:
    """Read a safetensors file; tensors are memory-mapped.

    Raises:
        InputFileError: It is missing, damaged, or holds weights that are not finite.
    """
    try:
        open_regular(file).close()
        tensors = load_file(file)
    except (OSError, InputFileError, SafetensorError) as error:
        raise InputFileError(f"{file} is damaged ({one_line(error)}). Take another checkpoint.") from error
    check_finite(tensors, file)
    return tensors


def read_archive(file: Path) -> Any:
    """Read an archive of tensors and plain values, as `torch.save` writes it.

    Args:
        file: The archive.

    Raises:
        OSError: The file cannot be read.
        InputFileError: It is damaged or compressed, or would execute code. The message begins with the file.
    """
    with open_regular(file) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                if sum(entry.file_size for entry in archive.infolist()) > stream.seek(0, 2):
                    raise InputFileError(f"{file} is a compressed zip archive; those of torch are not.")
                if archive.testzip():
                    raise zipfile.BadZipFile
            stream.seek(0)
            return torch.load(stream, map_location="cpu", weights_only=True)
        except (InputFileError, MemoryError):
            raise
        except zipfile.BadZipFile:
            raise InputFileError(
                f"{file} is damaged, ends too early, or is no torch zip archive, as torch.save writes it. "
                "Download it again."
            ) from None
        except pickle.UnpicklingError as error:  # its message advises to execute the code
            raise InputFileError(
                f"{file} holds more than tensors and plain values, which could execute code. Nothing was "
                "executed. Take it from where it is published."
            ) from error
        except Exception as error:  # a damaged file can fail in any way
            raise InputFileError(f"{file} is damaged ({one_line(error)}). Download it again.") from error


def write_safetensors(tensors: Mapping[str, torch.Tensor], file: Path) -> None:
    """Write a safetensors file, readable for whoever the umask allows; `save_file` would make it private.

    Raises:
        OSError: It cannot be written, for example because the disk is full.
    """
    file.write_bytes(save(dict(tensors)))


def file_digest(file: Path) -> str:
    """Return the SHA-256 of a file's content, as hexadecimal text."""
    with open_regular(file) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_finite(tensors: Mapping[str, torch.Tensor], file: Path) -> None:
    """Refuse weights that are NaN or infinite.

    Raises:
        InputFileError: Some are; the message names them.
    """
    found = [
        name
        for name, tensor in tensors.items()
        if tensor.is_floating_point()
        and tensor.numel()
        # 8-bit floats cannot be compared.
        and not all(
            bound.isfinite() for bound in torch.aminmax(tensor.float() if tensor.itemsize == 1 else tensor)
        )
    ]
    if found:
        raise InputFileError(
            f"{file}: {listed('weights that are not finite', found)[0]}. The training "
            "diverged, or the file is damaged; take another checkpoint."
        )


def mismatches(tensors: Mapping[str, torch.Tensor], expected: Mapping[str, torch.Tensor]) -> list[str]:
    """Describe how names, shapes and kinds of tensors differ from a network's, up to five of each."""
    wrong = [
        f"{name} is {described(tensors[name].dtype, tensors[name].shape)} instead of "
        f"{described(wanted.dtype, wanted.shape)}"
        for name, wanted in expected.items()
        if name in tensors
        and (
            tensors[name].shape != wanted.shape
            or tensors[name].is_floating_point() != wanted.is_floating_point()
        )
    ]
    return [
        *listed("missing", [name for name in expected if name not in tensors]),
        *listed("unexpected", [name for name in tensors if name not in expected]),
        *listed("wrong", wrong),
    ]


def check_replaceable(folder: Path, names: Collection[str]) -> None:
    """Check that a folder, whose content a new checkpoint replaces, is a checkpoint and nothing else.

    Raises:
        InputFileError: It is a file, or holds others than these.
    """
    if folder.is_file():
        raise InputFileError(f"{folder} is a file; give the name of a folder.")
    if folder.exists() and (others := sorted({path.name for path in folder.iterdir()} - {*names})):
        raise InputFileError(
            f"{folder} holds other files than a checkpoint ({', '.join(others[:_MAX_LISTED])}), which would "
            "be lost; give another folder."
        )


def read_description(folder: Path, kind: str) -> dict[str, Any]:
    """Read the config of a checkpoint folder.

    Args:
        folder: The folder.
        kind: Its kind, as the entry "policy" names it.

    Raises:
        InputFileError: There is none, it cannot be read, or is of another kind.
    """
    file = folder / CONFIG_FILE
    try:
        values = read_yaml(file)
    except FileNotFoundError:
        raise InputFileError(f"{folder} is no checkpoint: it holds no {CONFIG_FILE}.") from None
    if not isinstance(values, dict) or values.get("policy") != kind or "config" not in values:
        raise InputFileError(f"{file} does not describe a {kind!r} policy.")
    return values


def listed(what: str, names: Sequence[str]) -> list[str]:
    """Return ["what: first, second and 3 more"], or an empty list without names."""
    if not names:
        return []
    more = f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else ""
    return [f"{what}: {', '.join(map(echo, names[:_MAX_LISTED]))}{more}"]


def described(dtype: torch.dtype, shape: Sequence[int] | None = None) -> str:
    """Format a dtype, and a shape if given, such as "float32 (768, 4)"."""
    name = str(dtype).removeprefix("torch.")
    return name if shape is None else f"{name} {tuple(shape)}"
