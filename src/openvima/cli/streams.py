"""Output to terminals, files and pipes of any encoding."""

import codecs
import io
import sys
import unicodedata

_ALIKE = {
    **dict.fromkeys("–−—", "-"),
    **dict.fromkeys("“”„", '"'),
    **dict.fromkeys("‘’", "'"),
    **dict.fromkeys("─━═╌╴╶╸╺", "-"),
    **dict.fromkeys("│┃║", "|"),
    "×": "x",
    "·": ".",
    "•": "*",
    "→": "->",
    "≈": "~",
    "≤": "<=",
    "°": " deg",
    "±": "+-",
}


def accept_any_text() -> None:
    """Let stdout and stderr replace letters that their encoding lacks, instead of failing.

    Undecodable bytes of file names are written as they are.
    """
    codecs.register_error("openvima.alike", _alike)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="openvima.alike")


def _alike(error: UnicodeError) -> tuple[str | bytes, int]:
    """Replace the first letter of an encoding error by similar ASCII letters."""
    if not isinstance(error, UnicodeEncodeError):
        return codecs.backslashreplace_errors(error)
    letter = error.object[error.start]
    if "\udc80" <= letter <= "\udcff":  # as `os.fsdecode` stands for a byte
        return bytes([ord(letter) - 0xDC00]), error.start + 1
    return _ascii(letter), error.start + 1


def _ascii(letter: str) -> str:
    if letter in _ALIKE:
        return _ALIKE[letter]
    if "\u2500" <= letter <= "\u257f":  # box drawing
        return "+"
    plain = unicodedata.normalize("NFKD", letter)
    return "".join(c for c in plain if c.isascii()) or "?"
