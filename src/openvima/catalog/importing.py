"""Import of the original asset pack from a checkout into the cache."""

import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from openvima.atomic_io import atomic_write
from openvima.catalog.original import decode_file
from openvima.catalog.pack_files import ARCHIVE_NAME, CheckoutFiles, ImportedFiles, known_hashes
from openvima.errors import AssetError
from openvima.input_files import cache_dir

Report = Callable[[int, int, str], None]

_PROBLEMS_MEMBER = "problems.json"
_DATE = (1980, 1, 1, 0, 0, 0)  # the same checkout gives the same archive


@dataclass(frozen=True, slots=True)
class ImportedPack:
    """Result of an import.

    Args:
        archive: The archive in the cache.
        files: Imported files, as paths in the pack.
        problems: One sentence for each missing file.
    """

    archive: Path
    files: tuple[str, ...]
    problems: tuple[str, ...]

    @property
    def is_complete(self) -> bool:
        """Whether every file was imported."""
        return not self.problems


def import_pack(checkout: str | Path, report: Report | None = None) -> ImportedPack:
    """Import the original asset pack for `load_assets("original")`.

    Missing or damaged files are reported. An earlier import is replaced atomically.

    Args:
        checkout: Folder of a checkout of the original benchmark, or its assets folder.
        report: Called with the number of files done, the total, and the last name.

    Returns:
        Imported files and problems.

    Raises:
        AssetError: The folder contains no asset pack, or only damaged files.
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
    """Return the result of the last import, or None.

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
