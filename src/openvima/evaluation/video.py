"""Films: pictures to H.264 in an MP4 file that every browser plays."""

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

import numpy as np

from openvima.errors import ShapeError
from openvima.films import import_av, open_film

FRAMES_PER_SECOND = 30
_QUALITY = "21"  # x264's constant rate factor: textures stay clear, a film of 5 s takes about 100 kB


class VideoWriter:
    """Writes one film, picture by picture.

    The file is H.264 with 4:2:0 colours, its index in front, the same bytes for the same pictures.
    It gets its name when it is whole.

    Args:
        path: The file; its folder is made.
        width: Width of the pictures, even.
        height: Height of the pictures, even.
        frames_per_second: Speed.

    Raises:
        MissingExtraError: PyAV is not installed.
        ShapeError: A size is odd.

    Example:
        >>> with VideoWriter(Path("film.mp4"), 768, 384) as film:  # doctest: +SKIP
        ...     film.write(picture)
    """

    def __init__(
        self, path: Path, width: int, height: int, *, frames_per_second: int = FRAMES_PER_SECOND
    ) -> None:
        if width % 2 or height % 2:
            raise ShapeError(f"a film of {width} × {height} pixels cannot be encoded; both must be even.")
        import_av()  # before a folder is made
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path, self._partial = path, path.with_name(f".{path.name}.{os.getpid()}.tmp")
        self._shape = (height, width, 3)
        self._container, self._stream = open_film(self._partial, frames_per_second)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        # x264's macroblock tree gave other bytes in about 1 of 200 equal runs, in one thread as well
        options = {"crf": _QUALITY, "preset": "medium", "threads": "1", "x264-params": "mbtree=0"}
        self._stream.options = options

    def write(self, picture: np.ndarray, *, times: int = 1) -> None:
        """Add a picture.

        Args:
            picture: Shape (height, width, 3), uint8.
            times: For how many frames it stands.

        Raises:
            ShapeError: The picture has another size or dtype.
        """
        if picture.shape != self._shape or picture.dtype != np.uint8:
            raise ShapeError(
                f"picture is {picture.shape} {picture.dtype}; the film takes {self._shape} uint8."
            )
        for _ in range(times):
            frame = import_av().VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finish the film and give it its name."""
        self._container.mux(self._stream.encode(None))
        self._container.close()
        os.replace(self._partial, self._path)

    def discard(self) -> None:
        """Leave nothing, where the rest of the pictures will not come; an earlier film stays."""
        with contextlib.suppress(OSError):  # a container without pictures cannot be finished
            self._container.close()
        self._partial.unlink(missing_ok=True)

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()


def write_video(
    path: Path, pictures: Iterable[np.ndarray], *, frames_per_second: int = FRAMES_PER_SECOND
) -> Path:
    """Write pictures of one size as a film.

    Args:
        path: The file.
        pictures: At least one, shape (height, width, 3), uint8, sizes even.
        frames_per_second: Speed.

    Returns:
        The file.

    Raises:
        MissingExtraError: PyAV is not installed.
        ShapeError: There are no pictures, or their sizes are odd or differ.
    """
    pictures = iter(pictures)
    first = next(pictures, None)
    if first is None:
        raise ShapeError("a film needs at least one picture.")
    with VideoWriter(path, first.shape[1], first.shape[0], frames_per_second=frames_per_second) as film:
        film.write(first)
        for picture in pictures:
            film.write(picture)
    return path
