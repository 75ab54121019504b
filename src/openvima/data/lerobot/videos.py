"""The images of one feature as H.264 videos, many episodes per file.

Measured on 451 steps of 13 tasks: halving the resolution of colours (yuv420p) alone leaves 35 dB, with errors
of up to 185 of 255 levels on textures, however fine the quantiser. Without that and without loss (yuv444p,
quantiser 0) a picture is even smaller, 2.2 kB instead of 2.6, and off by at most 2 levels, from rounding
colours to YUV.
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, get_args

import numpy as np

from openvima.data.lerobot.layout import VIDEO_PATH, FileNumber
from openvima.data.schema import IMAGE_SHAPE
from openvima.render import channels_last
from openvima.video.encoder import import_av, open_video

PixelFormat = Literal["yuv444p", "yuv420p"]
PIXEL_FORMATS: tuple[PixelFormat, ...] = get_args(PixelFormat)

_QUALITY = {"yuv444p": {"qp": "0"}, "yuv420p": {"crf": "12"}}
_BYTES_PER_FRAME = 64  # generous share of the file's tables
MAX_FRAMES = 100_000  # in a file: of each one about 70 bytes stay in memory until it is closed


@dataclass(frozen=True, slots=True)
class VideoPlace:
    """Where the frames of an episode are.

    Args:
        number: The file.
        first_frame: Place of the first one in it, from 0.
    """

    number: FileNumber
    first_frame: int


class NumberedVideo:
    """The videos of one feature; a context manager.

    Each episode begins with a frame that needs no other, so reading one never decodes those before. There are
    no frames out of order, and encoders have one thread: the same pictures give the same bytes.

    Args:
        folder: The data set.
        key: Name of the feature.
        fps: Frames a second.
        pixels: Pixel format.
        limit_bytes: A file is closed before it becomes as large.

    Raises:
        MissingExtraError: PyAV is not installed.
    """

    def __init__(self, folder: Path, key: str, *, fps: int, pixels: PixelFormat, limit_bytes: int) -> None:
        self._av = import_av()
        self._folder, self._key = folder, key
        self._fps, self._pixels, self._limit_bytes = fps, pixels, limit_bytes
        self._number: FileNumber | None = None
        self._container: Any = None  # Any: PyAV is optional
        self._stream: Any = None
        self._num_frames = self._num_bytes = self._largest_frame = 0

    def write(self, pictures: np.ndarray, *, num_frames: int) -> VideoPlace:
        """Append an episode.

        Args:
            pictures: Shape (num_frames or 1, 3, height, width), uint8; one picture is shown all the time.
            num_frames: Frames of the episode.

        Returns:
            Where they are.
        """
        expected = num_frames * max(self._largest_frame, _BYTES_PER_FRAME)
        is_full = self._num_bytes + expected >= self._limit_bytes or self._num_frames >= MAX_FRAMES
        if self._number is None or is_full:
            self._begin()
        assert self._number is not None  # `_begin` has set it
        place = VideoPlace(self._number, self._num_frames)
        kinds = self._av.video.frame.PictureType
        frame: Any = None  # Any: PyAV is optional
        for index in range(num_frames):
            if index < len(pictures):
                picture = np.ascontiguousarray(channels_last(pictures[index]))
                frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.pict_type = self._num_frames, kinds.NONE if index else kinds.I
            self._mux(self._stream.encode(frame))
            self._num_frames += 1
        return place

    def close(self) -> None:
        """Finish the present file."""
        if self._container is not None:
            self._mux(self._stream.encode(None))
            self._container.close()
            self._container = self._stream = None

    def __enter__(self) -> "NumberedVideo":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        elif self._container is not None:
            with contextlib.suppress(OSError):  # the first error is the one to report
                self._container.close()

    def _begin(self) -> None:
        self.close()
        self._number = self._number.next() if self._number else FileNumber()
        self._num_frames = self._num_bytes = 0
        path = self._number.path(self._folder, VIDEO_PATH, video_key=self._key)
        self._container, self._stream = open_video(path, self._fps)
        self._stream.height, self._stream.width = IMAGE_SHAPE
        self._stream.pix_fmt = self._pixels
        # Without look-ahead a frame's bytes come at once, which the limit on files needs. The faster preset
        # costs 6 % in bytes and saves a third of the time.
        self._stream.options = {
            "preset": "superfast",
            "tune": "zerolatency",
            "threads": "1",
            "forced-idr": "1",
            **_QUALITY[self._pixels],
        }

    def _mux(self, packets: list[Any]) -> None:  # Any: PyAV is optional
        for packet in packets:
            self._largest_frame = max(self._largest_frame, packet.size + _BYTES_PER_FRAME)
            self._num_bytes += packet.size + _BYTES_PER_FRAME
        self._container.mux(packets)
