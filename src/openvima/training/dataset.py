"""Demonstrations whose images share one stack."""

from dataclasses import dataclass

from openvima.data.preprocessed import PreprocessedEpisode


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One demonstration whose images are part of a stack.

    Args:
        content: The demonstration.
        base: Images of the stack before its own: its image n has index `base + n` there, and 0 stays 0.
        row: Its number among all demonstrations.
        other: Another one, from which objects may be inserted.
    """

    content: PreprocessedEpisode
    base: int = 0
    row: int = 0
    other: "Example | None" = None

    @property
    def episode(self) -> PreprocessedEpisode:
        """The demonstration."""
        return self.content
