"""Filmed episodes: the film, the prompt in pieces, and how the episode ended."""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

from openvima.atomic_io import atomic_write_file
from openvima.errors import DatasetError

FOLDER = "videos"
_INDEX = "clips.json"


@dataclass(frozen=True, slots=True)
class Clip:
    """One filmed episode.

    Args:
        policy: Name of the policy in the results.
        task: Name of the task.
        level: Level of the episode.
        seed: Its seed, of domain "eval".
        success: Whether the task was done.
        steps: Actions taken.
        reason: Empty on success, else why not.
        prompt: The prompt in reading order: pieces of text, and pictures as PNG files.
        video: The film as an MP4 file.
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
        """Name of the film among those of one evaluation."""
        return f"{self.policy}_{self.task}_{self.level}_{self.seed}.mp4"


def save_clips(clips: Sequence[Clip], folder: Path) -> Path:
    """Write films and their list to the `videos` folder of an evaluation.

    Returns:
        The list, a JSON file; it is written last.
    """
    folder = folder / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    for clip in clips:
        (folder / clip.file_name).write_bytes(clip.video)
        prompt = [part if isinstance(part, str) else {"png": _text(part)} for part in clip.prompt]
        records.append(
            {
                "policy": clip.policy,
                "task": clip.task,
                "level": clip.level,
                "seed": clip.seed,
                "success": clip.success,
                "steps": clip.steps,
                "reason": clip.reason,
                "prompt": prompt,
                "poster": _text(clip.poster),
            }
        )
    return atomic_write_file(folder / _INDEX, json.dumps(records, indent=1, ensure_ascii=False) + "\n")


def load_clips(folder: Path) -> tuple[Clip, ...]:
    """Read the films of an evaluation's folder; none where nothing was filmed.

    Raises:
        DatasetError: The list is damaged or a film is missing.
    """
    index = folder / FOLDER / _INDEX
    if not index.is_file():
        return ()
    try:
        return tuple(_clip(record, index.parent) for record in json.loads(index.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{index} is damaged ({error}); delete {index.parent} and evaluate again."
        ) from error


def png(image: Image.Image) -> bytes:
    """Encode a picture as a PNG file."""
    stream = BytesIO()
    image.save(stream, "PNG", optimize=True)
    return stream.getvalue()


def _clip(record: dict[str, Any], folder: Path) -> Clip:  # Any: JSON
    prompt = tuple(part if isinstance(part, str) else _bytes(part["png"]) for part in record.pop("prompt"))
    poster = _bytes(record.pop("poster"))
    clip = Clip(**record, prompt=prompt, video=b"", poster=poster)
    return Clip(**record, prompt=prompt, poster=poster, video=(folder / clip.file_name).read_bytes())


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _bytes(text: str) -> bytes:
    return base64.b64decode(text, validate=True)
