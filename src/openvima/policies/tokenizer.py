"""Word tokenizer: a vocabulary is built from the prompts that a network is trained on, and stored with it.

Ids are 0 for padding, 1 for the end of the prompt, then the numbers from 0 to 360, then the words of the
vocabulary in their order. Ids behind them are a reserve: fine-tuning on new words takes them.
"""

import difflib
import hashlib
import json
import re
import unicodedata
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from openvima.atomic_io import atomic_write_file
from openvima.catalog import TEXTURES
from openvima.errors import InputFileError, PromptError, UnknownWordWarning, echo
from openvima.input_files import read_json

PADDING_ID, END_ID = 0, 1
LARGEST_NUMBER = 360
UNKNOWN = "<unknown>"  # takes the place of words that a vocabulary lacks; in a text, a masked word
VOCABULARY_FILE = "vocabulary.json"
RESERVE = 128  # unused ids of a new vocabulary, at least
MAX_WORDS = 20_000
MAX_WORD_LENGTH = 64  # characters
_FIRST_NUMBER_ID = 2
_FIRST_WORD_ID = _FIRST_NUMBER_ID + LARGEST_NUMBER + 1
_MAX_FILE_BYTES = 2**22
_MAX_WARNED = 256  # words that a policy warns of; a server's clients may send any number
_PIECE = re.compile(rf"{UNKNOWN}|[^\W\d_]+(?:-[^\W\d_]+)*|[0-9]+|\S")


def split_words(text: str) -> list[str]:
    """Split text into words, whole numbers and punctuation marks, in lower case; `UNKNOWN` is a word.

    Example:
        >>> split_words("Put it, counter-clockwise, 30 degrees.")
        ['put', 'it', ',', 'counter-clockwise', ',', '30', 'degrees', '.']
    """
    return _PIECE.findall(unicodedata.normalize("NFC", text.lower()))


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """The words that a network knows, in the order of their ids.

    Args:
        words: Words and punctuation marks; `UNKNOWN` where unknown words have an id.
        texture_words: Those that name textures, such as "blue" and "stripe"; sorted.

    Raises:
        PromptError: A word occurs twice or is none, or there are too many.
    """

    words: tuple[str, ...] = (UNKNOWN,)
    texture_words: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.words) > MAX_WORDS:
            raise PromptError(f"a vocabulary has {len(self.words)} words; allowed are {MAX_WORDS}.")
        seen: set[str] = set()
        for word in self.words:
            if word in seen or not (word == UNKNOWN or _is_word(word)):
                what = "twice" if word in seen else "which is no word in lower case"
                raise PromptError(f"a vocabulary holds {echo(repr(word), MAX_WORD_LENGTH)}, {what}.")
            seen.add(word)
        if others := sorted(set(self.texture_words) - seen):
            raise PromptError(
                f"a vocabulary lacks its texture word {echo(repr(others[0]), MAX_WORD_LENGTH)}."
            )

    @property
    def num_ids(self) -> int:
        """Number of ids in use."""
        return _FIRST_WORD_ID + len(self.words)

    def ids(self) -> dict[str, int]:
        """Return the ids of the words; ids below them are numbers from 0 to 360."""
        return {word: _FIRST_WORD_ID + index for index, word in enumerate(self.words)}

    def size_for(self, size: int) -> int:
        """Return `size` if so many embeddings suffice, else a larger number with a fresh reserve."""
        return size if self.num_ids <= size else -(-(self.num_ids + RESERVE) // RESERVE) * RESERVE

    def extended(self, texts: Iterable[str]) -> "Vocabulary":
        """Append the words of texts that it lacks, sorted.

        Args:
            texts: Without placeholders. What is longer than 64 characters or not printable stays unknown.

        Raises:
            PromptError: There are too many words.
        """
        known, new = set(self.words), set[str]()
        for text in texts:
            new.update(word for word in split_words(text) if word not in known and _is_word(word))
            if len(known) + len(new) > MAX_WORDS:
                raise PromptError(
                    f"the prompts have more than {MAX_WORDS} different words, the most that a vocabulary "
                    "holds; train on tasks with fewer, or on a preset that encodes prompts with T5."
                )
        named = new & {word for name in TEXTURES for word in split_words(name)} - {"and"}
        return Vocabulary(self.words + tuple(sorted(new)), tuple(sorted({*self.texture_words, *named})))

    def digest(self) -> str:
        """Return a hash of words and texture words."""
        return hashlib.blake2b(self._content().encode(), digest_size=16).hexdigest()

    def write(self, folder: Path) -> None:
        """Write `vocabulary.json` to a folder."""
        atomic_write_file(folder / VOCABULARY_FILE, self._content())

    @staticmethod
    def read(folder: Path) -> "Vocabulary":
        """Read the `vocabulary.json` of a folder.

        Raises:
            InputFileError: There is none, or it holds no vocabulary.
        """
        file = folder / VOCABULARY_FILE
        try:
            values = read_json(file, max_bytes=_MAX_FILE_BYTES)
        except FileNotFoundError:
            raise InputFileError(f"the checkpoint lacks its vocabulary, {file}.") from None
        if not isinstance(values, dict) or values.keys() != {"words", "texture_words"}:
            raise InputFileError(f"{file} must be a mapping with the keys words and texture_words.")
        try:
            return Vocabulary(_texts(values["words"]), _texts(values["texture_words"]))
        except PromptError as error:
            raise InputFileError(f"{file}: {error}") from error

    def _content(self) -> str:
        values = {"words": self.words, "texture_words": self.texture_words}
        return json.dumps(values, ensure_ascii=False, indent=0) + "\n"


@cache
def benchmark_vocabulary() -> Vocabulary:
    """Return the words of the benchmark's tasks and catalogue, for networks with fresh weights."""
    text = resources.files("openvima.policies").joinpath("vocabulary.txt").read_text(encoding="utf-8")
    return Vocabulary().extended([text])


class Tokenizer(Protocol):
    """Encodes prompt text as word ids; `END_ID` ends every prompt."""

    @property
    def texture_ids(self) -> np.ndarray:
        """Ids of words that name textures, which masked prompts leave out."""
        ...

    def encode(self, text: str) -> list[int]:
        """Encode text without placeholders; no end token is added."""
        ...


class WordTokenizer:
    """Encodes words by a vocabulary.

    Unknown words get the id of `UNKNOWN`, or none if the vocabulary lacks it. A warning names each of them
    once.

    Args:
        vocabulary: The words; by default those of the benchmark.
    """

    def __init__(self, vocabulary: Vocabulary | None = None) -> None:
        self.vocabulary = benchmark_vocabulary() if vocabulary is None else vocabulary
        self._ids = self.vocabulary.ids()
        self.texture_ids = np.array([self._ids[word] for word in self.vocabulary.texture_words], np.int64)
        self._warned: set[str] = set()

    def encode(self, text: str) -> list[int]:
        """Encode text, ignoring case.

        Args:
            text: Words, whole numbers and punctuation, without placeholders.

        Returns:
            One id for each word, number or punctuation mark, without end token.

        Example:
            >>> tokenizer = WordTokenizer(Vocabulary(("degrees", ".")))
            >>> tokenizer.encode("30 degrees.")
            [32, 363, 364]
        """
        pieces = split_words(text)
        found = [
            _FIRST_NUMBER_ID + int(piece) if _is_number(piece) else self._ids.get(piece) for piece in pieces
        ]
        if None in found:
            self._warn([piece for piece, token in zip(pieces, found, strict=True) if token is None])
        unknown = self._ids.get(UNKNOWN)
        return [token for each in found if (token := unknown if each is None else each) is not None]

    def save(self, folder: Path) -> None:
        """Write the vocabulary to a folder, which is created."""
        folder.mkdir(parents=True, exist_ok=True)
        self.vocabulary.write(folder)

    def _warn(self, unknown: list[str]) -> None:
        """Name unknown words once each; a bounded number of them, of bounded length."""
        words = dict.fromkeys(word[:MAX_WORD_LENGTH] for word in unknown if word != UNKNOWN)
        new = [word for word in words if word not in self._warned]
        new = new[: _MAX_WARNED - len(self._warned)]
        if not new:
            return
        self._warned.update(new)
        near = difflib.get_close_matches(new[0], self._ids, n=1, cutoff=0.8)
        warnings.warn(UnknownWordWarning({**dict.fromkeys(new, ""), new[0]: "".join(near)}), stacklevel=2)


def _is_number(piece: str) -> bool:
    """Whether it has an id in every vocabulary."""
    return re.fullmatch("[0-9]{1,3}", piece) is not None and int(piece) <= LARGEST_NUMBER


def _is_word(word: str) -> bool:
    is_short = len(word) <= MAX_WORD_LENGTH and word.isprintable()
    return is_short and split_words(word) == [word] and word != UNKNOWN and not _is_number(word)


def _texts(values: Any) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise PromptError("words and texture_words must be lists of text.")
    return tuple(values)
