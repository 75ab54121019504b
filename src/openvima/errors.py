"""Every exception of the package: a message says what was given, what is allowed and what to do."""

import difflib
import re
import reprlib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from typing import Any


class OpenVimaError(Exception):
    """Base class of all exceptions of the package."""


class UnknownNameError(OpenVimaError, KeyError):
    """A name of a task, object, texture or policy that does not exist."""

    def __str__(self) -> str:  # KeyError would print the repr of the message
        return str(self.args[0]) if self.args else ""


class UnknownTaskError(UnknownNameError):
    """There is no task of that name."""


class UnknownPolicyError(UnknownNameError):
    """There is no policy, preset or run folder of that name."""


class SamplingError(OpenVimaError, ValueError):
    """A task could not place its objects; another seed usually can."""


class ShapeError(OpenVimaError, ValueError):
    """An array of the wrong shape or dtype, or with values that its meaning excludes."""


class AssetError(OpenVimaError, ValueError):
    """A mesh, texture or asset folder is missing, damaged or unfit."""


class SceneError(OpenVimaError, ValueError):
    """A scene, placement or pose that cannot exist."""


class ActionError(OpenVimaError, ValueError):
    """An action out of bounds or reach, of wrong shape or dtype, or not finite. Nothing was moved."""


class EpisodeError(OpenVimaError, RuntimeError):
    """The environment was used in the wrong order, such as a step before a reset."""


class OracleError(OpenVimaError, RuntimeError):
    """The oracle has no action for the current scene."""


class WorkerError(OpenVimaError, RuntimeError):
    """A worker process died."""


class StorageError(OpenVimaError, OSError):
    """A folder cannot be written to, for example because the disk is full; complete files were kept."""


class FolderLockedError(OpenVimaError, RuntimeError):
    """Another process is writing to the folder."""


class DatasetError(OpenVimaError, ValueError):
    """Demonstrations or results are damaged, incomplete, of another version or unsuitable for the command."""


class PromptError(OpenVimaError, ValueError):
    """A prompt whose placeholders and images do not match, or that a policy cannot read."""


class PolicyError(OpenVimaError, ValueError):
    """Invalid inputs of a policy."""


class PolicyRaisedError(PolicyError):
    """The code of a policy raised in `reset` or `act`."""


class InputFileError(OpenVimaError, ValueError):
    """A file or checkpoint is no regular file, too large, damaged, of another format or does not fit."""


class ConfigError(OpenVimaError, ValueError):
    """An option or level that does not exist or is out of range, or options that contradict each other."""


class MessageError(OpenVimaError, ValueError):
    """A message between policy server and client is malformed or out of order."""


class ServerError(OpenVimaError, ConnectionError):
    """A policy server or the Hugging Face Hub cannot be reached, was lost or refuses a request."""


class AnswerError(OpenVimaError, ValueError):
    """An answer of a language model holds no action; a policy returns it in place of one.

    Args:
        kind: What is wrong, for counting.
        details: What was given instead.
    """

    def __init__(self, kind: str, details: str) -> None:
        super().__init__(f"{kind}; {details}.")
        self.kind = kind


class LimitReachedError(OpenVimaError, RuntimeError):
    """An evaluation has used up its requests or tokens; what is finished was kept."""


class MissingExtraError(OpenVimaError, ImportError):
    """An optional dependency is not installed; the message names the extra."""


class UnknownWordWarning(UserWarning):
    """Prompts have words that the policy never saw in training.

    Args:
        words: The words, each with a known one to suggest, or an empty text.
    """

    def __init__(self, words: Mapping[str, str]) -> None:
        shown = echo(", ".join(map(repr, words)), _MAX_WORDS)
        known = ", ".join(repr(word) for word in list(filter(None, words.values()))[:_MAX_SUGGESTIONS])
        hint = f" Did you mean {known}?" if known else ""
        super().__init__(
            f"prompts have words that the policy never saw in training: {shown}.{hint} Use other words, or "
            f"train it on prompts with these."
        )
        self.words = dict(words)

    def __reduce__(self) -> tuple[type, tuple[dict[str, str]]]:
        return type(self), (self.words,)


@contextmanager
def handle_unknown_words(handle: Callable[[UnknownWordWarning], object]) -> Iterator[None]:
    """Call a function with the warnings of unknown words inside the block, instead of showing them."""
    shown = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *place: Any) -> None:
        if isinstance(message, UnknownWordWarning):
            handle(message)
        else:
            shown(message, category, *place)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = shown


@contextmanager
def one_word_warning() -> Iterator[None]:
    """Warn of all unknown words inside the block once, at its end."""
    found: list[UnknownWordWarning] = []
    try:
        with handle_unknown_words(found.append):
            yield
    finally:
        if found:
            words = {word: near for warning in found for word, near in warning.words.items()}
            warnings.warn(UnknownWordWarning(words), stacklevel=3)


_MAX_WORDS = 1000  # characters of unknown words in a warning
_MAX_SUGGESTIONS = 3
MAX_ECHO = 200  # characters of what others sent that an error repeats


def echo(text: str, limit: int = MAX_ECHO) -> str:
    """Shorten text of others for an error and replace its control characters.

    Args:
        text: What a client, a server or a file holds; it may be hostile to the terminal that shows it.
        limit: Characters to keep.
    """
    first = text[: limit + 1]
    shown = (c if c.isprintable() else " " if c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in first)
    return cut("".join(shown), limit)


def one_line(error: BaseException) -> str:
    """Return the message of an error in one line of limited length."""
    return " ".join(str(error).split())[:MAX_ECHO].rstrip(".") or type(error).__name__


def differences(there: Mapping[str, object], here: Mapping[str, object]) -> list[str]:
    """Say which settings of a file differ from those given, for an error."""
    return [
        f"{echo(name)} is {echo(repr(there.get(name)))} there and {echo(repr(here.get(name)))} here"
        for name in {**there, **here}
        if there.get(name) != here.get(name)
    ]


def unknown_name(kind: str, name: object, known: Iterable[str], hint: str = "") -> str:
    """Compose the message for an unknown name, with a known one that has it, or is near, as a suggestion.

    Args:
        kind: Kind of thing, such as "task".
        name: The name as given.
        known: All names that are allowed.
        hint: Last sentence; by default the known names, if there are at most 20.

    Returns:
        One line for an `UnknownNameError`.
    """
    known, given = list(known), str(name)[:MAX_ECHO]
    # "vima" suggests "vima-nano", the first preset that has this word, and not the most similar one.
    holding = [entry for entry in known if given.lower() in re.split(r"[\W_]+", entry.lower())]
    near = holding or difflib.get_close_matches(given, known, n=1)
    suggestion = f" Did you mean {near[0]!r}?" if near else ""
    if not hint and len(known) <= 20:
        hint = f"Allowed: {', '.join(known)}."
    return f"there is no {kind} {echo(repr(name))}.{suggestion} {hint}".rstrip()


class Terminated(KeyboardInterrupt):
    """A training was ended by SIGTERM; while it takes steps, it writes a checkpoint before it stops."""


MAX_CHARACTERS = 800  # of a representation


class _BriefRepr(reprlib.Repr):
    """Shows a few items of a collection, and of arrays and tensors their dtype and shape."""

    def repr_instance(self, x: Any, level: int) -> str:
        """Show an array, or anything else, in limited length."""
        if hasattr(x, "dtype") and hasattr(x, "shape"):
            return f"<{x.dtype} {tuple(x.shape)}>"
        return super().repr_instance(x, level)


_BRIEF = _BriefRepr()
_BRIEF.maxlevel = _BRIEF.maxdict = _BRIEF.maxset = _BRIEF.maxfrozenset = 3
_BRIEF.maxtuple = _BRIEF.maxlist = 8
_BRIEF.maxstring = _BRIEF.maxother = 100


def brief_repr(self: Any) -> str:
    """Represent a dataclass briefly; for `__repr__ = brief_repr` in its body.

    Example:
        >>> Frame(np.zeros((3, 128, 256), np.uint8), boxes, masks)  # doctest: +SKIP
        Frame(rgb=<uint8 (3, 128, 256)>, boxes=<float32 (2, 4)>, masks=<bool (2, 128, 256)>)
    """
    parts = (f"{each.name}={_BRIEF.repr(getattr(self, each.name))}" for each in fields(self) if each.repr)
    return cut(f"{type(self).__name__}({', '.join(parts)})", MAX_CHARACTERS)


def cut(text: str, length: int) -> str:
    """Cut a text to a length, with an ellipsis."""
    return text if len(text) <= length else f"{text[: length - 1]}…"
