"""H.264 encoding in MP4 files with PyAV, which is imported on first use. Equal frames give equal bytes."""

import contextlib
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from openvima.atomic_io import atomic_path
from openvima.errors import ShapeError
from openvima.imports import import_extra

FRAMES_PER_SECOND = 30
_CRF = "21"  # keeps textures clear at about 100 kB for 5 s


def import_av() -> Any:  # Any: PyAV is optional
    """Import PyAV.

    Raises:
        MissingExtraError: It is not installed.
    """
    return import_extra("av", "videos need PyAV; install it with: pip install 'openvima[report]'")


def open_video(path: Path, frames_per_second: int) -> tuple[Any, Any]:  # Any: PyAV is optional
    """Open an MP4 file for writing, with its index at the front.

    Args:
        path: The file.
        frames_per_second: Frame rate.

    Returns:
        The container and its stream, whose size, pixel format and quality are still to be set.

    Raises:
        MissingExtraError: PyAV is not installed.
    """
    options = {"movflags": "+faststart", "fflags": "+bitexact"}
    container = import_av().open(str(path), "w", format="mp4", options=options)
    return container, container.add_stream("libx264", rate=frames_per_second)


class VideoWriter:
    """Writes one video, frame by frame; a context manager.

    The file is H.264 with 4:2:0 chroma subsampling, which every browser plays. It appears under its name
    once it is complete; if the block raises, a file of that name is left as it was.

    Args:
        path: The file; its folder is made.
        width: Width of the frames, even.
        height: Height of the frames, even.
        frames_per_second: Frame rate.

    Raises:
        MissingExtraError: PyAV is not installed.
        ShapeError: A size is odd.

    Example:
        >>> with VideoWriter(Path("video.mp4"), 768, 384) as video:  # doctest: +SKIP
        ...     video.write(frame)
    """

    def __init__(
        self, path: Path, width: int, height: int, *, frames_per_second: int = FRAMES_PER_SECOND
    ) -> None:
        if width % 2 or height % 2:
            raise ShapeError(f"a video of {width} × {height} pixels cannot be encoded; both must be even.")
        self._av = import_av()  # before a folder is made
        path.parent.mkdir(parents=True, exist_ok=True)
        self._shape = (height, width, 3)
        with contextlib.ExitStack() as closing:
            partial = closing.enter_context(atomic_path(path))
            self._container, self._stream = open_video(partial, frames_per_second)
            self._closing = closing.pop_all()
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        # x264's macroblock tree gave other bytes in about 1 of 200 equal runs, in one thread as well
        self._stream.options = {"crf": _CRF, "preset": "medium", "threads": "1", "x264-params": "mbtree=0"}

    def write(self, frame: np.ndarray, *, repeat: int = 1) -> None:
        """Append a frame.

        Args:
            frame: Shape (height, width, 3), uint8.
            repeat: How many times to append it.

        Raises:
            ShapeError: The frame has another size or dtype.
        """
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise ShapeError(
                f"got a frame of {frame.shape} {frame.dtype}; the video takes {self._shape} uint8."
            )
        for _ in range(repeat):
            encoded = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            self._container.mux(self._stream.encode(encoded))

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            with contextlib.suppress(OSError):  # a container without frames cannot be finished
                self._container.close()
            self._closing.__exit__(kind, error, trace)
            return
        with self._closing:
            self._container.mux(self._stream.encode(None))
            self._container.close()
