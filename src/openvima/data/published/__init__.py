"""Reading and importing the data set that the benchmark's authors published."""

from typing import TYPE_CHECKING

from openvima.imports import lazy_names

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

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
