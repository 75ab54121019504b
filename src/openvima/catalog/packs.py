"""Loading of asset packs by name, folder or function.

Records name a user's function without its folder. They never run it: whoever reads one loads the assets
first.
"""

import os
from functools import lru_cache
from pathlib import Path

from openvima.catalog.geometry import Assets
from openvima.catalog.procedural import procedural_assets
from openvima.errors import AssetError, echo, unknown_name
from openvima.input_files import as_path
from openvima.user_code import call_function, is_code, with_absolute_path, without_folder

_LOADED_VARIABLE = "OPENVIMA_LOADED_ASSETS"  # sources, one a line; worker processes inherit it
_packs: dict[str, "UserAssets"] = {}  # by source


class UserAssets:
    """A pack under the name of the function that made it.

    Args:
        source: MODULE:FUNCTION or FILE.py:FUNCTION, with the whole path.
        base: The pack.
    """

    def __init__(self, source: str, base: Assets) -> None:
        self.source = source
        self.name = without_folder(source)
        self.geometry, self.texture = base.geometry, base.texture

    def __repr__(self) -> str:
        return f"UserAssets({self.source!r})"

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return load_user_assets, (self.source,)


def load_user_assets(source: str) -> UserAssets:
    """Run a function without arguments once per process, and return its pack.

    Args:
        source: MODULE:FUNCTION or FILE.py:FUNCTION. The function registers objects and textures, and returns
            None for these and the built-in ones; or it returns an implementation of `Assets`.

    Raises:
        ConfigError: There is no such function, or it fails.
        AssetError: It returned something else, or registered something unfit.
    """
    whole = with_absolute_path(source)
    if whole in _packs:
        return _packs[whole]
    made = call_function(whole, what="assets")
    if made is not None and not isinstance(made, Assets):
        raise AssetError(
            f"assets is {source!r}, whose function returned a {type(made).__name__}; return None, or an "
            "object with a name and the methods geometry and texture."
        )
    _packs[whole] = UserAssets(whole, made or procedural_assets())
    os.environ[_LOADED_VARIABLE] = "\n".join(dict.fromkeys([*_loaded_sources(), whole]))
    return _packs[whole]


def recorded_assets(name: str) -> str:
    """Return what to load for the assets that a data set or another record names, without running code.

    Args:
        name: As in the record.

    Raises:
        AssetError: It names a function that has not been loaded in this process or the one that started it.
    """
    if not is_code(name):
        return name
    known = [source for source in _loaded_sources() if without_folder(source) == without_folder(name)]
    if not known:
        shown = echo(name)
        raise AssetError(
            f"the record names assets {shown}, code that is not run without being asked for; pass --assets "
            f"with the path of {shown}, or call openvima.catalog.load_assets with it first."
        )
    return known[-1]


def _loaded_sources() -> list[str]:
    return os.environ.get(_LOADED_VARIABLE, "").splitlines()


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
        if not isinstance(assets, Assets):
            raise AssetError(
                f"assets is a {type(assets).__name__}; give a name, a folder, or an object with a name "
                "and the methods geometry and texture."
            )
        return assets
    if assets == "procedural":
        return procedural_assets()
    if assets == "original":
        from openvima.catalog.original import imported_pack

        return _original(imported_pack())
    if is_code(str(assets)):
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
def _original(source: Path) -> Assets:
    from openvima.catalog.original import OriginalAssets  # reads files, which the default pack does not

    return OriginalAssets(source)
