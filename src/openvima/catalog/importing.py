"""Importing the original asset pack: from a checkout into one archive in the cache, decoded once."""

import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from openvima.atomic_io import atomic_write
from openvima.catalog.cache import cache_dir
from openvima.catalog.original import decode_file
from openvima.catalog.pack_files import ARCHIVE_NAME, CheckoutFiles, ImportedFiles, known_hashes
from openvima.errors import AssetError

Report = Callable[[int, int, str], None]

_PROBLEMS_MEMBER = "problems.json"
_DATE = (1980, 1, 1, 0, 0, 0)  # the same checkout gives the same archive


@dataclass(frozen=True, slots=True)
class ImportedPack:
    """What an import found.

    Args:
        archive: The archive in the cache.
        files: Paths in the pack of the files that it holds.
        problems: One sentence for each file that it lacks, with the reason.
    """

    archive: Path
    files: tuple[str, ...]
    problems: tuple[str, ...]

    @property
    def is_complete(self) -> bool:
        """Whether every file was imported."""
        return not self.problems


def import_pack(checkout: str | Path, report: Report | None = None) -> ImportedPack:
    """Import the original asset pack; from then on `load_assets("original")` gives it.

    Files that are missing or damaged are left out and reported. An earlier import is replaced in one move,
    once the new one is whole.

    Args:
        checkout: Folder of a checkout of the original benchmark, or its assets folder.
        report: Is told how many files of how many are done, and the name of the last one.

    Returns:
        What was imported and what was not.

    Raises:
        AssetError: The folder holds no asset pack, or not one sound file of it.
        OSError: The cache cannot be written to.
    """
    source = CheckoutFiles.within(checkout)
    contents: dict[str, bytes] = {}
    problems = []
    for done, relative_path in enumerate(known_hashes(), start=1):
        try:
            decode_file(source, relative_path)
            contents[relative_path] = source.read(relative_path)
        except AssetError as error:
            problems.append(str(error))
        if report:
            report(done, len(known_hashes()), relative_path)
    if not contents:
        raise AssetError(f"none of the {len(problems)} files in {source.folder} is sound; {problems[0]}")
    archive = cache_dir() / ARCHIVE_NAME
    _write_archive(archive, contents, problems)
    return ImportedPack(archive, tuple(contents), tuple(problems))


def imported_pack() -> ImportedPack | None:
    """Return what the last import found, or None if there was none.

    Raises:
        AssetError: The archive is damaged.
    """
    try:
        archive = ImportedFiles.present().archive
    except AssetError:
        return None
    try:
        with zipfile.ZipFile(archive) as file:
            problems = json.loads(file.read(_PROBLEMS_MEMBER))
            names = tuple(name for name in file.namelist() if name in known_hashes())
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise AssetError(
            f"{archive} is damaged ({error}); delete it, or import the pack again with "
            "`openvima assets import CHECKOUT`."
        ) from error
    return ImportedPack(archive, names, tuple(problems))


def _write_archive(archive: Path, contents: dict[str, bytes], problems: list[str]) -> None:
    archive.parent.mkdir(parents=True, exist_ok=True)
    members = {**contents, _PROBLEMS_MEMBER: json.dumps(problems, indent=1).encode()}
    with atomic_write(archive) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as packed:
        for name, content in members.items():
            packed.writestr(zipfile.ZipInfo(name, _DATE), content)
