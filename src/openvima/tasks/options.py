"""Validation of task options."""

from typing import Literal, get_args

from openvima.catalog import Pool
from openvima.errors import ConfigError, unknown_name
from openvima.tasks.table import TableSampler

Difficulty = Literal["easy", "medium", "hard"]
"""Published results are all at "easy"."""


def check_difficulty(difficulty: str) -> None:
    """Check a difficulty.

    Raises:
        ConfigError: It is unknown.
    """
    if difficulty not in get_args(Difficulty):
        raise ConfigError(unknown_name("difficulty", difficulty, get_args(Difficulty)))


def check_count(name: str, count: object, *, high: int, low: int = 0) -> None:
    """Check that a number of objects is in `low` … `high`.

    Raises:
        ConfigError: It is not.
    """
    if isinstance(count, bool) or not isinstance(count, int) or not low <= count <= high:
        raise ConfigError(f"{name} is {count!r}; give an integer from {low} to {high}.")


def check_fraction(name: str, value: object) -> None:
    """Check that a number is in 0 … 1.

    Raises:
        ConfigError: It is not.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
        raise ConfigError(f"{name} is {value!r}; give a number from 0 to 1.")


def textures_by_difficulty(table: TableSampler, difficulty: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the textures of dragged objects and of bases.

    Args:
        table: Its pool is used; "medium" draws once.
        difficulty: "easy": the pool's; "medium": both from one of the two lists; "hard": swapped.
    """
    check_difficulty(difficulty)
    pool: Pool = table.pool
    dragged, base = pool.dragged_textures, pool.base_textures
    if difficulty == "hard":
        return base, dragged
    if difficulty == "medium":
        return (base, base) if table.rng.random() < 0.5 else (dragged, dragged)
    return dragged, base
