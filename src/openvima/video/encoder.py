"""H.264 encoding in MP4 files with PyAV, which is imported on first use. Equal frames give equal bytes.

Clips are recorded episodes in the folder of an evaluation; animations stay in memory, for trackers.
"""

import base64
import contextlib
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from openvima.atomic_io import atomic_path, atomic_write_file
from openvima.errors import DatasetError, ShapeError, echo
from openvima.imports import import_extra
from openvima.input_files import MALFORMED

# Every browser plays 4:2:0 chroma subsampling; the rest keeps textures clear at about 100 kB for 5 s.
_PIXELS, _OPTIONS = "yuv420p", {"crf": "21", "preset": "medium"}


def import_av() -> Any:
    """Import PyAV.

    Raises:
        MissingExtraError: It is not installed.
    """
    return import_extra("av", "videos need PyAV; install it with: pip install 'openvima[report]'")


WriteFrame = Callable[..., None]  # as `open_video` yields it


@contextlib.contextmanager
def open_video(
    path: Path,
    width: int,
    height: int,
    *,
    frames_per_second: int,
    pixels: str = _PIXELS,
    options: Mapping[str, str] = _OPTIONS,
) -> Iterator[WriteFrame]:
    """Write one video, frame by frame.

    The file is H.264 with its index at the front. It appears under its name once it is complete; if the block
    raises, a file of that name is left as it was.

    Args:
        path: The file; its folder is made.
        width: Width of the frames, even.
        height: Height of the frames, even.
        frames_per_second: Frame rate.
        pixels: Pixel format.
        options: Options of x264, such as quality.

    Yields:
        A function that appends a frame of shape (height, width, 3), uint8. With `repeat` it does so as many
        times, with `is_key` the first of these is encoded without others.

    Raises:
        MissingExtraError: PyAV is not installed.
        ShapeError: A size is odd, or a frame has another size or dtype.

    Example:
        >>> with open_video(Path("video.mp4"), 768, 384, frames_per_second=30) as write:  # doctest: +SKIP
        ...     write(frame)
    """
    if width % 2 or height % 2:
        raise ShapeError(f"a video of {width} × {height} pixels cannot be encoded; both must be even.")
    av = import_av()  # before a folder is made
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as partial:
        flags = {"movflags": "+faststart", "fflags": "+bitexact"}
        container = av.open(str(partial), "w", format="mp4", options=flags)
        stream = container.add_stream("libx264", rate=frames_per_second)
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        # x264's macroblock tree gave other bytes in about 1 of 200 equal runs, in one thread as well
        stream.options = {**options, "threads": "1", "x264-params": "mbtree=0"}

        def write(frame: np.ndarray, *, repeat: int = 1, is_key: bool = False) -> None:
            shape = (height, width, 3)
            if frame.shape != shape or frame.dtype != np.uint8:
                raise ShapeError(
                    f"got a frame of {frame.shape} {frame.dtype}; the video takes {shape} uint8."
                )
            for number in range(repeat):
                encoded = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
                if is_key and not number:
                    encoded.pict_type = av.video.frame.PictureType.I
                container.mux(stream.encode(encoded))

        try:
            yield write
            container.mux(stream.encode(None))
        except BaseException:
            with contextlib.suppress(OSError):  # a container without frames cannot be finished
                container.close()
            raise
        container.close()


@dataclass(frozen=True, slots=True, eq=False)
class Animation:
    """An episode as it was rolled out.

    Args:
        name: Such as the task.
        caption: How the episode ended.
        prompt: The prompt as a picture, shape (H, W, 3), uint8.
        frames: Shape (T, H, W, 3), uint8.
        frames_per_second: Frame rate.
    """

    name: str
    caption: str
    prompt: np.ndarray
    frames: np.ndarray
    frames_per_second: int

    def gif(self) -> bytes:
        """Encode the frames as an animated GIF, which needs no further package."""
        first, *others = map(Image.fromarray, self.frames)
        content = io.BytesIO()
        duration_ms = 1000 // self.frames_per_second
        first.save(content, "GIF", save_all=True, append_images=others, duration=duration_ms, loop=0)
        return content.getvalue()


FOLDER = "videos"
_INDEX = "clips.json"


@dataclass(frozen=True, slots=True)
class Clip:
    """One recorded episode.

    Args:
        policy: Name of the policy in the results.
        task: Name of the task.
        level: Level of the episode.
        seed: Its seed, of domain "eval".
        success: Whether the episode was solved.
        steps: Actions taken.
        reason: Empty on success, else why not.
        prompt: The prompt in reading order: text, and images as PNG files.
        video: The MP4 file.
        poster: The first frame as a PNG file.
    """

    policy: str
    task: str
    level: str
    seed: int
    success: bool
    steps: int
    reason: str
    prompt: tuple[str | bytes, ...]
    video: bytes
    poster: bytes

    @property
    def file_name(self) -> str:
        """Name of the video among those of one evaluation."""
        return f"{self.policy}_{self.task}_{self.level}_{self.seed}.mp4"


def save_clips(clips: Sequence[Clip], folder: Path) -> Path:
    """Write videos and their index to the `videos` folder of an evaluation.

    Returns:
        The index, a JSON file; it is written last.
    """
    folder = folder / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    for clip in clips:
        atomic_write_file(folder / clip.file_name, clip.video)
        record = asdict(clip) | {"poster": _text(clip.poster)}
        del record["video"]
        records.append(record)
    content = json.dumps(records, indent=1, ensure_ascii=False, default=lambda image: {"png": _text(image)})
    return atomic_write_file(folder / _INDEX, content + "\n")


def load_clips(folder: Path) -> tuple[Clip, ...]:
    """Read the clips of an evaluation's folder; none if nothing was recorded.

    Raises:
        DatasetError: The index is damaged or leads out of the folder, or a video is missing.
    """
    index = folder / FOLDER / _INDEX
    if not index.is_file():
        return ()
    try:
        return tuple(_clip(record, index.parent) for record in json.loads(index.read_text(encoding="utf-8")))
    except (OSError, *MALFORMED) as error:
        raise DatasetError(
            f"{index} is damaged ({error}); delete {index.parent} and evaluate again."
        ) from error


def png(image: Image.Image) -> bytes:
    """Encode an image as a PNG file."""
    stream = io.BytesIO()
    image.save(stream, "PNG", optimize=True)
    return stream.getvalue()


def _clip(record: dict[str, Any], folder: Path) -> Clip:
    prompt = tuple(part if isinstance(part, str) else _bytes(part["png"]) for part in record.pop("prompt"))
    clip = Clip(**{**record, "poster": _bytes(record["poster"])}, prompt=prompt, video=b"")
    if Path(clip.file_name).name != clip.file_name:
        raise ValueError(f"{echo(repr(clip.file_name))} leads out of the folder")
    return replace(clip, video=(folder / clip.file_name).read_bytes())


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _bytes(text: str) -> bytes:
    return base64.b64decode(text, validate=True)
