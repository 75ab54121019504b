"""Make docs/performance.md, one table of the performance figures recorded in results/.

    python benchmarks/performance_table.py [--results DIR] [--out FILE]

A result is a file results/YYYY-MM-DD_NAME.json, with NAME.md beside it. For each figure that belongs in the
table it has one entry in its top-level list "performance":

    {"performance": [{"what": "VIMA-200M, decision 5, against no KV cache", "value": 3.9, "unit": "×",
                      "command": "python benchmarks/policy.py", "commit": "9270b8e", "against": "39ff454"}]}

what:    What was measured; the key of the row. A newer result replaces the row of an older one.
value:   A number, or a text such as "9 to 27".
unit:    "episodes/s", "ms", "%", "×", ….
command: The command that measures it.
commit:  The commit that was measured.
against: Only for a ratio of two commits: the commit before, measured in the same run.

The date is that of the file's name. Rows are in the order of the files, then of their entries. Ratios of two
commits, and figures whose script no longer exists, stay in the records alone.
"""

import argparse
import json
import re
from dataclasses import asdict, dataclass, fields
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "performance.md"
HEAD = """# Performance

The newest figures of each kind. Each is that of the machine in its record, where command and commit are.
Made by `python benchmarks/performance_table.py`; do not edit.

| what | figure |
|---|---:|
"""


class RowError(ValueError):
    """A result has an entry that does not fit the table."""


@dataclass(frozen=True, slots=True)
class Row:
    """One figure; the fields are those of an entry in "performance", see the module."""

    what: str
    value: float | str
    unit: str
    command: str
    commit: str
    against: str = ""

    def cells(self, source: Path) -> str:
        """Return the row in Markdown."""
        value = self.value if isinstance(self.value, str) else f"{self.value:,}"
        figure = f"{value}{'' if self.unit == '×' else ' '}{self.unit}"
        return f"| {self.what} | [{figure}](../results/{source.with_suffix('.md').name}) |"


def read_rows(results: Path) -> dict[str, tuple[Row, Path]]:
    """Return the newest row of each figure and the file that it comes from, by `what`.

    Raises:
        RowError: An entry lacks a field, has an unknown one, or is there twice on one day.
    """
    rows: dict[str, tuple[Row, Path]] = {}
    for file in sorted(results.glob("*.json")):
        content = json.loads(file.read_text(encoding="utf-8"))
        for entry in content.get("performance", ()):
            row = _row(entry, file)
            other = rows.pop(row.what, None)
            if other and other[1].name[:10] == file.name[:10]:
                raise RowError(f"{file.name}: {row.what!r} is in {other[1].name} of the same day, too.")
            rows[row.what] = (row, file)
    return rows


def _row(entry: dict, file: Path) -> Row:
    try:
        row = Row(**entry)
    except TypeError:
        known = ", ".join(field.name for field in fields(Row))
        raise RowError(f"{file.name}: {entry} does not have the fields {known}.") from None
    if any("|" in str(cell) or "\n" in str(cell) for cell in asdict(row).values()):
        raise RowError(f"{file.name}: {entry} has a bar or a line break, which ends a cell of the table.")
    return row


def page(results: Path) -> str:
    """Return docs/performance.md."""
    found = read_rows(results).values()
    rows = [(row, file) for row, file in found if not row.against and _can_be_repeated(row)]
    return HEAD + "".join(f"{row.cells(file)}\n" for row, file in rows)


def _can_be_repeated(row: Row) -> bool:
    return all((ROOT / script).exists() for script in re.findall(r"benchmarks/\w+\.py", row.command))


def main() -> None:
    """Write the page."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--results", type=Path, default=ROOT / "results", help="folder of results")
    parser.add_argument("--out", type=Path, default=PAGE, help="file to write")
    options = parser.parse_args()
    options.out.write_text(page(options.results), encoding="utf-8")


if __name__ == "__main__":
    main()
