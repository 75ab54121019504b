"""Where a LeRobot data set keeps its files, and when it begins a new one.

Source: the format's documentation (huggingface.co/docs/lerobot/lerobot-dataset-v3) and lerobot 0.4.4.
"""

from dataclasses import dataclass
from pathlib import Path

CODEBASE_VERSION = "v3.0"
FILES_PER_CHUNK = 1000
DATA_FILE_MB = 100
VIDEO_FILE_MB = 200
BYTES_PER_MB = 1024**2

INFO_PATH = "meta/info.json"
STATISTICS_PATH = "meta/stats.json"
TASKS_PATH = "meta/tasks.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"

# Not part of the format: where the episodes came from.
SOURCE_PATH = "meta/openvima.json"
SOURCE_EPISODES_PATH = "meta/openvima.parquet"


@dataclass(frozen=True, slots=True)
class FileNumber:
    """The place of one of the numbered files, `chunk-000/file-000` and so on."""

    chunk: int = 0
    file: int = 0

    def next(self) -> "FileNumber":
        """Return the place of the file after this one."""
        if self.file + 1 == FILES_PER_CHUNK:
            return FileNumber(self.chunk + 1, 0)
        return FileNumber(self.chunk, self.file + 1)

    def path(self, folder: Path, pattern: str, **names: str) -> Path:
        """Return the file's path; its folder is made.

        Args:
            folder: The data set.
            pattern: One of the patterns above.
            **names: What else the pattern asks for.
        """
        path = folder / pattern.format(chunk_index=self.chunk, file_index=self.file, **names)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path
