"""Clips: recorded episodes with their prompt and outcome, stored in the folder of an evaluation."""

import base64
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

from openvima.atomic_io import atomic_write_file
from openvima.errors import DatasetError, echo

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
        record = asdict(clip)
        del record["video"]
        record["prompt"] = [part if isinstance(part, str) else {"png": _text(part)} for part in clip.prompt]
        record["poster"] = _text(clip.poster)
        records.append(record)
    return atomic_write_file(folder / _INDEX, json.dumps(records, indent=1, ensure_ascii=False) + "\n")


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
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DatasetError(
            f"{index} is damaged ({error}); delete {index.parent} and evaluate again."
        ) from error


def png(image: Image.Image) -> bytes:
    """Encode an image as a PNG file."""
    stream = BytesIO()
    image.save(stream, "PNG", optimize=True)
    return stream.getvalue()


def _clip(record: dict[str, Any], folder: Path) -> Clip:  # Any: JSON
    prompt = tuple(part if isinstance(part, str) else _bytes(part["png"]) for part in record.pop("prompt"))
    poster = _bytes(record.pop("poster"))
    clip = Clip(**record, prompt=prompt, video=b"", poster=poster)
    if Path(clip.file_name).name != clip.file_name:
        raise ValueError(f"{echo(repr(clip.file_name))} leads out of the folder")
    return Clip(**record, prompt=prompt, poster=poster, video=(folder / clip.file_name).read_bytes())


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _bytes(text: str) -> bytes:
    return base64.b64decode(text, validate=True)
