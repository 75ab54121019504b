"""Loading of asset packs by name, folder or function."""

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from openvima.catalog.geometry import Assets, is_pack
from openvima.catalog.procedural import procedural_assets
from openvima.errors import AssetError, unknown_name
from openvima.input_files import as_path
from openvima.user_code import is_code

if TYPE_CHECKING:
    from openvima.catalog.pack_files import PackFiles

ASSET_PACKS = ("procedural", "original")
"""Named packs; anything else is a function of a user, or the path of a checkout of VIMA-Bench."""


def load_assets(assets: str | Path | Assets = "procedural") -> Assets:
    """Return an asset pack; each is loaded once per process.

    Args:
        assets: "procedural"; "original" after `openvima assets import`, or the path of a checkout of
            VIMA-Bench; MODULE:FUNCTION or FILE.py:FUNCTION, which is run, see `user_assets`; or a pack, which
            is returned unchanged.

    Raises:
        AssetError: The name is unknown, the folder contains no original pack, none was imported, or an object
            is no pack.
        ConfigError: There is no such function, or it fails.

    Example:
        >>> load_assets("procedural").texture("blue")
        array([[[ 78, 121, 167]]], dtype=uint8)
    """
    if not isinstance(assets, str | Path):
        if not is_pack(assets):
            raise AssetError(
                f"assets is a {type(assets).__name__}; give a name, a folder, or an object with the methods "
                "geometry and texture."
            )
        return assets
    if assets == "procedural":
        return procedural_assets()
    if assets == "original":
        from openvima.catalog.pack_files import ImportedFiles

        return _original(ImportedFiles.present())
    if is_code(str(assets)):
        from openvima.catalog.user_assets import load_user_assets

        return load_user_assets(str(assets))
    folder = as_path(assets)
    if not folder.is_dir():
        hint = (
            "Allowed: 'procedural', 'original', MODULE:FUNCTION, FILE.py:FUNCTION, or the folder of a "
            "checkout of the original benchmark."
        )
        raise AssetError(unknown_name("asset pack or folder", str(assets), ASSET_PACKS, hint))
    return _original(folder.resolve())


@lru_cache(maxsize=4)
def _original(source: "Path | PackFiles") -> Assets:
    from openvima.catalog.original import OriginalAssets  # reads files, which the default pack does not

    return OriginalAssets(source)
