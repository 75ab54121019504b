"""Tokenizer of prompts over the benchmark's closed vocabulary.

The vocabulary is in `vocabulary.txt`, one word a line. New words are appended: the line number is the word's
id in every checkpoint.
"""

import difflib
import re
from functools import cache
from importlib import resources
from typing import Protocol

from openvima.catalog import TEXTURES
from openvima.errors import PromptError, echo

PADDING_ID, END_ID = 0, 1
LARGEST_NUMBER = 360
_FIRST_NUMBER_ID = 2
_FIRST_WORD_ID = _FIRST_NUMBER_ID + LARGEST_NUMBER + 1
_MAX_SHOWN = 100  # characters of the text, and of its unknown words, in an error
_PIECE = re.compile(r"[a-z]+(?:-[a-z]+)*|[0-9]+|\S")


@cache
def word_ids() -> dict[str, int]:
    """Return the ids of all words and punctuation marks; ids below them are numbers from 0 to 360."""
    text = resources.files("openvima.policies").joinpath("vocabulary.txt").read_text(encoding="utf-8")
    return {word: _FIRST_WORD_ID + index for index, word in enumerate(text.split())}


@cache
def texture_word_ids() -> frozenset[int]:
    """Return the ids of words in texture names, such as "blue" and "stripe"."""
    words = {word for name in TEXTURES for word in name.split()} - {"and"}
    return frozenset(word_ids()[word] for word in words)


def vocabulary_size() -> int:
    """Number of ids: padding, end token, numbers and words."""
    return _FIRST_WORD_ID + len(word_ids())


def encode_text(text: str) -> list[int]:
    """Encode text, ignoring case.

    Args:
        text: Words, whole numbers from 0 to 360 and punctuation, without placeholders.

    Returns:
        One id for each word, number or punctuation mark, without end token.

    Raises:
        PromptError: A word or number is not in the vocabulary.

    Example:
        >>> encode_text("30 degrees.") == [32, word_ids()["degrees"], word_ids()["."]]
        True
    """
    ids, unknown = [], []
    for piece in _PIECE.findall(text.lower()):
        token = _number_id(piece) if piece[0] in "0123456789" else word_ids().get(piece)
        if token is None:
            unknown.append(piece)
        else:
            ids.append(token)
    if unknown:
        raise PromptError(_unknown_words(unknown, text))
    return ids


class Tokenizer(Protocol):
    """Encodes prompt text as word ids."""

    @property
    def end_id(self) -> int:
        """Id that ends every prompt."""
        ...

    def encode(self, text: str) -> list[int]:
        """Encode text without placeholders; no end token is added."""
        ...


class ClosedTokenizer:
    """The benchmark's closed vocabulary of a few hundred ids, with no download. See `encode_text`."""

    end_id = END_ID

    def encode(self, text: str) -> list[int]:
        """Encode text without placeholders; no end token is added."""
        return encode_text(text)


CLOSED_TOKENIZER = ClosedTokenizer()


def _number_id(digits: str) -> int | None:
    if len(digits) > len(str(LARGEST_NUMBER)) or int(digits) > LARGEST_NUMBER:
        return None
    return _FIRST_NUMBER_ID + int(digits)


def _unknown_words(unknown: list[str], text: str) -> str:
    shown = echo(", ".join(repr(word) for word in dict.fromkeys(unknown)), _MAX_SHOWN)
    near = difflib.get_close_matches(unknown[0][:_MAX_SHOWN], word_ids(), n=1)
    suggestion = f" Did you mean {near[0]!r}?" if near else ""
    return (
        f"the prompt text {echo(repr(text), _MAX_SHOWN)} contains {shown}, which the policy's vocabulary "
        f"lacks.{suggestion} It holds the words of the 17 tasks and whole numbers from 0 to {LARGEST_NUMBER}."
    )
