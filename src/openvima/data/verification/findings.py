"""Settings and results of a verification."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from openvima.errors import ConfigError
from openvima.multiprocess import check_workers

Report = Callable[[int, int, str], None]

_MAX_ROWS_NAMED = 8


@dataclass(frozen=True, slots=True)
class VerifyConfig:
    """Settings of a verification.

    Args:
        replay: Episodes of each task to replay in the simulator; None means all.
        seed: Decides which episodes are replayed.
        assets: Asset pack to replay with, as for `openvima generate`; None means the one of that name.
        workers: Number of processes.

    Raises:
        ConfigError: A number is out of its range.
    """

    replay: int | None = 1
    seed: int = 0
    assets: str | None = None
    workers: int = 1

    def __post_init__(self) -> None:
        if self.replay is not None and self.replay < 0:
            raise ConfigError(f"replay is {self.replay}; it must be 0 or more, or all.")
        check_workers(self.workers)


@dataclass(frozen=True, slots=True, order=True)
class Problem:
    """A problem of one file.

    Args:
        file: Name of the file, relative to the data folder.
        cause: What is wrong with it.
        remedy: What to do.
    """

    file: str
    cause: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.file}: {self.cause}. {self.remedy}"


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of a verification.

    Args:
        folder: The data folder.
        problems: All problems, by file.
        notes: Remarks that are no problems.
        num_shards: Shards that were checked.
        num_episodes: Episodes that were decoded and compared with their content hashes.
        num_replayed: Episodes that were replayed.
        num_cache_files: Files of the object cache that were compared with the demonstrations.
        damaged: Names of shards that are missing or have other bytes than were written.
    """

    folder: Path
    problems: tuple[Problem, ...]
    notes: tuple[str, ...] = ()
    num_shards: int = 0
    num_episodes: int = 0
    num_replayed: int = 0
    num_cache_files: int = 0
    damaged: tuple[str, ...] = ()

    @property
    def is_clean(self) -> bool:
        """Whether there are no problems."""
        return not self.problems

    def joined(self, other: "Verification") -> "Verification":
        """Add the results of a folder inside this one."""
        names = [field.name for field in fields(self) if field.name != "folder"]
        return replace(self, **{name: getattr(self, name) + getattr(other, name) for name in names})

    def record(self) -> dict[str, Any]:  # Any: JSON
        """Return everything as plain values."""
        return {
            "folder": str(self.folder),
            "clean": self.is_clean,
            "shards": self.num_shards,
            "episodes": self.num_episodes,
            "replayed": self.num_replayed,
            "cache_files": self.num_cache_files,
            "problems": [asdict(problem) for problem in self.problems],
            "notes": list(self.notes),
        }


def by_cause(faults: Iterable[tuple[int, str]], num_rows: int) -> list[str]:
    """Group faults of records by cause.

    Args:
        faults: Row and cause of each.
        num_rows: Rows of the shard.

    Returns:
        One text per cause, with the rows.
    """
    rows: dict[str, list[int]] = {}
    for row, cause in faults:
        rows.setdefault(cause, []).append(row)
    return [f"{cause} ({_listed(found)} of {num_rows})" for cause, found in rows.items()]


def _listed(rows: list[int]) -> str:
    shown = ", ".join(str(row) for row in rows[:_MAX_ROWS_NAMED])
    more = f" and {len(rows) - _MAX_ROWS_NAMED} more" if len(rows) > _MAX_ROWS_NAMED else ""
    return f"record{'s' if len(rows) > 1 else ''} {shown}{more}"
