"""Look at the shapes and textures, and import those of the original benchmark."""

import sys
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def gallery(*, out: Path, assets: str = "procedural") -> int:
    """Write a web page that shows every object and every texture.

    Example: openvima assets gallery --out gallery

    Args:
        out: Folder to write index.html and its pictures to.
        assets: procedural, original (see `openvima assets import`), a checkout of the original benchmark,
            or FILE.py:FUNCTION, which registers assets of your own.

    Returns:
        Exit status.
    """
    from openvima.catalog import load_assets
    from openvima.render.gallery import write_gallery
    from openvima.tasks import list_tasks

    list_tasks()  # files of tasks may register objects and textures
    page, problems = write_gallery(out, load_assets(assets))
    for problem in problems:
        print(problem, file=sys.stderr)
    print(page)
    return 1 if problems else 0


def import_(
    checkout: Annotated[Positional[Path], arg(metavar="CHECKOUT")],
) -> int:
    """Import the asset pack of the original benchmark; then "--assets original" uses it everywhere.

    The checkout is read once and not needed afterwards. Files that are missing or damaged are listed and the
    rest is imported. Importing again replaces what was imported before.

    Example: openvima assets import ~/VIMABench

    Args:
        checkout: Folder of a checkout of the original benchmark.

    Returns:
        Exit status: 0 everything was imported, 1 files are missing.
    """
    from openvima.catalog.original import import_pack, imported_folder, known_hashes

    problems = import_pack(checkout)
    total = len(known_hashes())
    print(f"{total - len(problems)} of {total} files imported into {imported_folder()}")
    _list_problems(problems)
    print("--assets original uses what is there.", file=sys.stderr)
    return 1 if problems else 0


def info() -> None:
    """Show which asset packs there are, and what the cache holds.

    Example: openvima assets info
    """
    from openvima.catalog import OBJECTS, TEXTURES
    from openvima.catalog.objects import REGISTERED_OBJECTS
    from openvima.catalog.original import OriginalAssets, imported_folder, known_hashes
    from openvima.catalog.textures import REGISTERED_TEXTURES
    from openvima.input_files import cache_dir
    from openvima.tasks import list_tasks

    problems: list[str] = []
    print(f"procedural  made by code: {len(OBJECTS)} objects, {len(TEXTURES)} textures")
    list_tasks()  # files of tasks may register objects and textures
    if own := [*REGISTERED_OBJECTS, *REGISTERED_TEXTURES]:
        num_objects = len(REGISTERED_OBJECTS)
        print(f"registered  {num_objects} objects, {len(own) - num_objects} textures: {', '.join(own)}")
    if (folder := imported_folder()).is_dir():
        problems, total = OriginalAssets(folder).problems(), len(known_hashes())
        print(f"original    {total - len(problems)} of {total} files imported: {folder}")
    else:
        print("original    not imported; `openvima assets import CHECKOUT` reads it from a checkout")
    size_mb = sum(file.stat().st_size for file in cache_dir().rglob("*") if file.is_file()) / 1e6
    print(f"cache       {size_mb:.0f} MB in {cache_dir()}; all but the import is made anew when needed")
    _list_problems(problems)


def _list_problems(problems: list[str]) -> None:
    if problems:
        print(f"{len(problems)} not imported:", file=sys.stderr)
    for problem in problems:
        print(f"  {problem}", file=sys.stderr)


COMMANDS = {"gallery": gallery, "import": import_, "info": info}
