"""Reading and importing the data set that the benchmark's authors published."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from openvima.data.published.importing import ImportConfig, import_published
    from openvima.data.published.reader import Broken, EpisodeKey, PublishedData

# Each name brings only what it needs.
_HOMES = {
    "Broken": "reader",
    "EpisodeKey": "reader",
    "ImportConfig": "importing",
    "PublishedData": "reader",
    "import_published": "importing",
}

__all__ = ["Broken", "EpisodeKey", "ImportConfig", "PublishedData", "import_published"]


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(importlib.import_module(f"openvima.data.published.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
