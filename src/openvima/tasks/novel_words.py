"""Invented words, and gray object images."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.errors import ConfigError
from openvima.scene import ObjectImage, Placement
from openvima.tasks.table import NO_SCALE, TableSampler

ADJECTIVES = ("daxer", "blicker", "modier", "kobar")
NOUNS = ("dax", "blicket", "wug", "zup")
_WORD = re.compile(r"[^\W\d_]+(-[^\W\d_]+)*")


def choose_words(
    table: TableSampler, option: str, words: str | Sequence[str], *, count: int = 1
) -> tuple[str, ...]:
    """Draw distinct words.

    Args:
        table: Source of the draws.
        option: Name of the option, for errors.
        words: A word or a list of words.
        count: Number of words.

    Raises:
        ConfigError: The list is too short, or has duplicates or invalid words.
    """
    if not isinstance(words, Iterable):
        raise ConfigError(f"{option} is {words!r}; give a word or a list of words.")
    listed = (words,) if isinstance(words, str) else tuple(words)
    wrong = [word for word in listed if not (isinstance(word, str) and _WORD.fullmatch(word))]
    if wrong or len(set(listed)) < max(len(listed), count):
        given = ", ".join(map(repr, wrong or listed)) or "nothing"
        raise ConfigError(f"{option} holds {given}; give at least {count} different words, letters only.")
    return tuple(listed[int(i)] for i in table.rng.permutation(len(listed))[:count])


def in_any_order(table: TableSampler, sentences: Sequence[str]) -> list[str]:
    """Return sentences in random order."""
    return [sentences[int(i)] for i in table.rng.permutation(len(sentences))]


def gray_image(placement: Placement) -> ObjectImage:
    """Return an image of the shape alone, without texture and scale."""
    return ObjectImage(replace(placement, texture=NEUTRAL_TEXTURE, scale=NO_SCALE))
