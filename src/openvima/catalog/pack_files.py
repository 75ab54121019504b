"""Files of the original asset pack, in a checkout or in the archive of an import.

Every file is compared with a known hash, so that an incomplete or different pack is reported.
"""

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from openvima.errors import AssetError
from openvima.input_files import cache_dir

PACK_FOLDER = Path("vima_bench/tasks/assets")  # inside a checkout
ARCHIVE_NAME = "original-pack-1.zip"  # the number is that of the archive's layout
IMPORT_COMMAND = "openvima assets import CHECKOUT"
_TEXT_SUFFIXES = (".obj", ".urdf")


class PackFiles(Protocol):
    """The files of an original pack; instances with the same files are equal."""

    def read(self, relative_path: str) -> bytes:
        """Return a file's content, as in the original benchmark.

        Args:
            relative_path: One of `known_hashes`.

        Raises:
            AssetError: The file is missing, unreadable, damaged or of another version.
        """
        ...


@dataclass(frozen=True, slots=True)
class CheckoutFiles:
    """The files of a checkout of the original benchmark.

    Args:
        folder: The pack's folder, absolute.
    """

    folder: Path

    @classmethod
    def within(cls, checkout: str | Path) -> "CheckoutFiles":
        """Find the pack in a checkout.

        Args:
            checkout: Folder of the checkout (it holds `vima_bench/tasks/assets`), or that assets folder.

        Raises:
            AssetError: The folder holds no asset pack.
        """
        candidates = (Path(checkout) / PACK_FOLDER, Path(checkout))
        folder = next((path for path in candidates if (path / "textures").is_dir()), None)
        if folder is None:
            raise AssetError(
                f"{checkout} holds no original asset pack ({PACK_FOLDER}/textures is missing); "
                "give the folder of a VIMABench checkout."
            )
        return cls(folder.resolve())

    def read(self, relative_path: str) -> bytes:
        """Return a file's content; see `PackFiles.read`."""
        path = self.folder / relative_path
        try:
            content = path.read_bytes()
        except OSError as error:
            raise AssetError(
                f"{path} is missing or unreadable; complete the checkout of VIMABench."
            ) from error
        original = _as_original(content, relative_path)
        if original is None:
            raise AssetError(
                f"{path} differs from the file of the original benchmark (damaged, or another version); "
                "restore it from a fresh checkout of VIMABench."
            )
        return original


@dataclass(frozen=True, slots=True)
class ImportedFiles:
    """The files that were imported into the cache.

    Args:
        archive: The archive.
        stamp: Identifies the version of the archive.
    """

    archive: Path
    stamp: tuple[int, ...]

    @classmethod
    def present(cls) -> "ImportedFiles":
        """Find the imported pack.

        Raises:
            AssetError: None was imported.
        """
        archive = cache_dir() / ARCHIVE_NAME
        try:
            status = archive.stat()
        except OSError:
            raise AssetError(
                f"the original asset pack has not been imported ({archive} is missing). Run "
                f"`{IMPORT_COMMAND}` with the folder of a VIMABench checkout, or use the pack 'procedural'."
            ) from None
        return cls(archive, (status.st_mtime_ns, status.st_size, status.st_ino))

    def read(self, relative_path: str) -> bytes:
        """Return a file's content; see `PackFiles.read`."""
        try:
            with zipfile.ZipFile(self.archive) as archive:
                content = archive.read(relative_path)
        except KeyError:
            raise AssetError(
                f"the imported original pack lacks {relative_path}, which the checkout did not hold or held "
                f"damaged; complete the checkout of VIMABench and run `{IMPORT_COMMAND}` again."
            ) from None
        except (OSError, zipfile.BadZipFile) as error:
            raise AssetError(
                f"{relative_path} cannot be read from {self.archive} ({error}); run `{IMPORT_COMMAND}` again."
            ) from error
        if _as_original(content, relative_path) is None:
            raise AssetError(
                f"{relative_path} in {self.archive} differs from the file of the original benchmark; "
                f"run `{IMPORT_COMMAND}` again."
            )
        return content


@lru_cache(maxsize=1)
def known_hashes() -> Mapping[str, str]:
    """Return the SHA-256 of every file that is imported, by path in the pack."""
    text = Path(__file__).with_name("original_files.json").read_text(encoding="utf-8")
    return MappingProxyType(json.loads(text))


def _as_original(content: bytes, relative_path: str) -> bytes | None:
    """The content if it is the known one; Git for Windows may have changed the line ends of text files."""
    candidates = [content]
    if relative_path.endswith(_TEXT_SUFFIXES):
        candidates.append(content.replace(b"\r\n", b"\n"))
    expected = known_hashes()[relative_path]
    return next((c for c in candidates if hashlib.sha256(c).hexdigest() == expected), None)
