"""Invented words, and pictures that show what a noun means by shape alone."""

import re
from collections.abc import Sequence
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
    """Draw different words from a list that a user may have given.

    Args:
        table: The draw is made by its generator.
        option: Name of the option that holds the list.
        words: The list; a single word counts as a list of one.
        count: How many to draw.

    Raises:
        ConfigError: The list holds fewer words, one twice, or something that is no word.
    """
    listed = (words,) if isinstance(words, str) else tuple(words)
    wrong = [word for word in listed if not (isinstance(word, str) and _WORD.fullmatch(word))]
    if wrong or len(set(listed)) < max(len(listed), count):
        shown = ", ".join(map(repr, wrong or listed)) or "nothing"
        raise ConfigError(f"{option} holds {shown}; give at least {count} different words, letters only.")
    return tuple(listed[int(i)] for i in table.rng.permutation(len(listed))[:count])


def in_any_order(table: TableSampler, sentences: Sequence[str]) -> list[str]:
    """Return sentences in an order drawn at random."""
    return [sentences[int(i)] for i in table.rng.permutation(len(sentences))]


def gray_image(placement: Placement) -> ObjectImage:
    """Show the shape of an object and nothing else: no texture, no scale."""
    return ObjectImage(replace(placement, texture=NEUTRAL_TEXTURE, scale=NO_SCALE))
