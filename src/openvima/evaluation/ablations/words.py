"""Ablations of the words of a prompt; image slots and their order stay.

A word is a run of letters, with hyphens inside, or a whole number. Descriptions in text prompts are words.

Source of masked and swapped words: VIMA (Jiang et al. 2023), robustness against incomplete and corrupted
prompts. The rates are free here.
"""

import re
from collections.abc import Iterator
from functools import cache

import numpy as np

from openvima.policies.tokenizer import UNKNOWN, benchmark_vocabulary
from openvima.tasks.registry import task_spec

_SLOT_OR_WORD = re.compile(rf"\{{\w+\}}|{UNKNOWN}|[^\W\d_]+(?:-[^\W\d_]+)*|[0-9]+")
_SLOT_OR_PIECE = re.compile(r"\{\w+\}|[A-Za-z]+(?:-[A-Za-z]+)*|\d+|\S")
_COMPARED = re.compile(r"(?<=\bsame )(texture|profile)\b")
_LETTERS = "abcdefghijklmnopqrstuvwxyz"


def masked(text: str, rate: float, rng: np.random.Generator) -> str:
    """Replace each word by the unknown token with a probability.

    Example:
        >>> masked("Put the {a} into it.", 1, np.random.default_rng(0))
        '<unknown> <unknown> {a} <unknown> <unknown>.'
    """
    words = _words(text)
    return _with_words(text, [UNKNOWN if rng.random() < rate else word.group() for word in words])


def swapped(text: str, rate: float, rng: np.random.Generator) -> str:
    """Swap neighbouring words, from left to right, each pair with a probability.

    Neighbours have nothing but space between them, so no word crosses an image or a mark. A word may be
    carried on by the next swap; on average that fraction of the neighbouring pairs is swapped.

    Example:
        >>> swapped("Put the {a} into it.", 1, np.random.default_rng(0))
        'the Put {a} it into.'
    """
    places = _words(text)
    words = [place.group() for place in places]
    for i in range(len(words) - 1):
        are_neighbours = not text[places[i].end() : places[i + 1].start()].strip()
        if are_neighbours and rng.random() < rate:
            words[i], words[i + 1] = words[i + 1], words[i]
    return _with_words(text, words)


def gibberish(text: str, rng: np.random.Generator) -> str:
    """Replace the letters of each word by random ones, in each place of a word by the same."""
    known: dict[str, str] = {}

    def replaced(word: str) -> str:
        if word.isdecimal() or word == UNKNOWN:
            return word
        if word.lower() not in known:
            drawn = iter(rng.choice(list(_LETTERS), len(word)).tolist())
            known[word.lower()] = "".join(next(drawn) if letter != "-" else "-" for letter in word)
        new = known[word.lower()]
        return new.capitalize() if word[0].isupper() else new

    return _with_words(text, [replaced(word.group()) for word in _words(text)])


def scrambled(text: str, rng: np.random.Generator) -> str:
    """Replace each word, number and mark by a random word of the benchmark."""
    pieces = _SLOT_OR_PIECE.findall(text)
    drawn = rng.choice(_benchmark_words(), len(pieces)).tolist()
    return " ".join(piece if piece[0] == "{" else word for piece, word in zip(pieces, drawn, strict=True))


def with_other_attribute(text: str) -> str:
    """Compare objects by the other attribute: by profile in place of texture, by texture in place of profile.

    Example:
        >>> with_other_attribute("Put all objects with the same texture as {a} into it.")
        'Put all objects with the same profile as {a} into it.'
    """
    return _COMPARED.sub(lambda found: "profile" if found[0] == "texture" else "texture", text)


def names_attribute(task: str) -> bool:
    """Whether the prompt of a task says by which attribute objects are compared."""
    return _COMPARED.search(task_spec(task).template) is not None


def _words(text: str) -> list[re.Match[str]]:
    return [found for found in _SLOT_OR_WORD.finditer(text) if found.group()[0] != "{"]


def _with_words(text: str, words: list[str]) -> str:
    """Put other words in the places of a text's words."""
    left: Iterator[str] = iter(words)
    return _SLOT_OR_WORD.sub(lambda found: found.group() if found.group()[0] == "{" else next(left), text)


@cache
def _benchmark_words() -> tuple[str, ...]:
    return tuple(sorted(word for word in benchmark_vocabulary().words if word[0].isalpha()))
