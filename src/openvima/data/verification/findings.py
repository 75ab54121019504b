"""What a verification is asked for, and what it finds."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from openvima.errors import ConfigError
from openvima.multiprocess import check_workers

Report = Callable[[int, int, str], None]

_SHOWN_ROWS = 8  # of those that a problem concerns


@dataclass(frozen=True, slots=True)
class VerifyConfig:
    """How thoroughly to look.

    Args:
        replay: Episodes of each task to play again; None means all.
        seed: Another one replays other episodes.
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
    """Something that is not as it should be.

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
    """What was looked at, and what was found.

    Args:
        folder: The data folder.
        problems: All problems, by file.
        notes: What is worth knowing but not wrong.
        num_shards: Shards that were looked at.
        num_episodes: Episodes that were decoded and compared with their content hashes.
        num_replayed: Episodes that were played again.
        num_token_files: Files of tokens that were compared with what is cut out of the demonstrations now.
        damaged: Names of shards whose bytes are not those that were written, or that are missing.
    """

    folder: Path
    problems: tuple[Problem, ...]
    notes: tuple[str, ...] = ()
    num_shards: int = 0
    num_episodes: int = 0
    num_replayed: int = 0
    num_token_files: int = 0
    damaged: tuple[str, ...] = ()

    @property
    def is_clean(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    def joined(self, other: "Verification") -> "Verification":
        """Add what was found in a folder inside this one."""
        return Verification(
            folder=self.folder,
            problems=self.problems + other.problems,
            notes=self.notes + other.notes,
            num_shards=self.num_shards + other.num_shards,
            num_episodes=self.num_episodes + other.num_episodes,
            num_replayed=self.num_replayed + other.num_replayed,
            num_token_files=self.num_token_files + other.num_token_files,
            damaged=self.damaged + other.damaged,
        )

    def record(self) -> dict[str, Any]:  # Any: JSON
        """Return everything as plain values."""
        return {
            "folder": str(self.folder),
            "clean": self.is_clean,
            "shards": self.num_shards,
            "episodes": self.num_episodes,
            "replayed": self.num_replayed,
            "token_files": self.num_token_files,
            "problems": [asdict(problem) for problem in self.problems],
            "notes": list(self.notes),
        }


def by_cause(faults: Iterable[tuple[int, str]], num_rows: int) -> list[str]:
    """Say once what is wrong with several records.

    Args:
        faults: Row and what is wrong with it.
        num_rows: Rows of the shard.

    Returns:
        One text a cause, with the rows.
    """
    rows: dict[str, list[int]] = {}
    for row, cause in faults:
        rows.setdefault(cause, []).append(row)
    return [f"{cause} ({_listed(found)} of {num_rows})" for cause, found in rows.items()]


def _listed(rows: list[int]) -> str:
    shown = ", ".join(str(row) for row in rows[:_SHOWN_ROWS])
    more = f" and {len(rows) - _SHOWN_ROWS} more" if len(rows) > _SHOWN_ROWS else ""
    return f"record{'s' if len(rows) > 1 else ''} {shown}{more}"
