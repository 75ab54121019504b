"""Demonstrations whose images share one stack."""

from collections.abc import Sequence
from dataclasses import dataclass

from openvima.data.object_cache.episode import PreprocessedEpisode


class StoredEpisode:
    """A demonstration of an object cache, read when it is asked for.

    Args:
        cache: The object cache.
        row: Its number there.
        num_steps: Number of its actions.
    """

    def __init__(self, cache: Sequence[PreprocessedEpisode], row: int, num_steps: int) -> None:
        self.cache, self.row, self.num_steps = cache, row, num_steps
        self._episode: PreprocessedEpisode | None = None

    @property
    def is_read(self) -> bool:
        """Whether it was read already."""
        return self._episode is not None

    def read(self) -> PreprocessedEpisode:
        """Return it; it is read once."""
        if self._episode is None:
            self._episode = self.cache[self.row]
        return self._episode


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One demonstration whose images are part of a stack.

    Args:
        content: The demonstration, perhaps not read yet.
        base: Images of the stack before its own: its image n has index `base + n` there, and 0 stays 0.
        row: Its number among all demonstrations.
        other: Another one, from which objects may be inserted.
    """

    content: PreprocessedEpisode | StoredEpisode
    base: int = 0
    row: int = 0
    other: "Example | None" = None

    @property
    def episode(self) -> PreprocessedEpisode:
        """The demonstration."""
        content = self.content
        return content.read() if isinstance(content, StoredEpisode) else content

    @property
    def num_steps(self) -> int:
        """Number of its actions, known before it is read."""
        return self.content.num_steps
