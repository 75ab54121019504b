"""Tables of the catalogue that lie in JSON files."""

from pathlib import Path
from typing import Any

from openvima.input_files import read_json


def read_records(file: Path) -> list[dict[str, Any]]:
    """Read a list of records, as keyword arguments of frozen dataclasses: their lists become tuples."""
    records: list[dict[str, Any]] = read_json(file)
    for record in records:
        record |= {name: tuple(value) for name, value in record.items() if isinstance(value, list)}
    return records
