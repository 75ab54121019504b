"""H.264 films in MP4 files: equal pictures make equal bytes, and PyAV is loaded where one is made only."""

from pathlib import Path
from typing import Any

from openvima.errors import MissingExtraError


def import_av() -> Any:  # Any: PyAV is optional
    """Import PyAV.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import av
    except ImportError as error:
        message = "films need PyAV; install it with: pip install 'openvima[report]'"
        raise MissingExtraError(message) from error
    return av


def open_film(path: Path, frames_per_second: int) -> tuple[Any, Any]:  # Any: PyAV is optional
    """Open a film for writing, with its index in front.

    Args:
        path: The file.
        frames_per_second: Speed.

    Returns:
        The container and its stream, whose size, pixel format and quality are still to be set.

    Raises:
        MissingExtraError: PyAV is not installed.
    """
    options = {"movflags": "+faststart", "fflags": "+bitexact"}
    container = import_av().open(str(path), "w", format="mp4", options=options)
    return container, container.add_stream("libx264", rate=frames_per_second)
