"""Tables of the catalogue that lie in JSON files, and look-ups by name."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from openvima.errors import UnknownNameError, unknown_name
from openvima.input_files import read_json

T = TypeVar("T")


def read_records(file: Path) -> list[dict[str, Any]]:
    """Read a list of records, as keyword arguments of frozen dataclasses: their lists become tuples."""
    records: list[dict[str, Any]] = read_json(file)
    for record in records:
        record |= {name: tuple(value) for name, value in record.items() if isinstance(value, list)}
    return records


def find_record(kind: str, name: str, built_in: Mapping[str, T], registered: Mapping[str, T]) -> T:
    """Look up an "object" or a "texture".

    Raises:
        UnknownNameError: There is none of that name; the message suggests the nearest one.
    """
    try:
        return built_in.get(name) or registered[name]
    except (KeyError, TypeError):
        hint = (
            f"`openvima.catalog.{kind.upper()}S` holds the {len(built_in)} built-in ones; your own need "
            f"`register_{kind}`, in a file of OPENVIMA_TASK_FILES or for --assets."
        )
        raise UnknownNameError(unknown_name(kind, name, (*built_in, *registered), hint)) from None
