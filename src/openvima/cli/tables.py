"""Tables for terminals of any width."""

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

PIPE_WIDTH = 150  # characters, where nothing says how wide the reader is


def table_console() -> "Console":
    """Return a console on stdout as wide as the terminal; a file or a pipe takes long lines."""
    from rich.console import Console

    console = Console(highlight=False)
    return console if console.is_terminal or "COLUMNS" in os.environ else Console(width=PIPE_WIDTH)


def print_table(table: "Table", console: "Console | None" = None, *, num_heads: int = 1) -> None:
    """Print a table, or a short paragraph for each row where the terminal is too narrow for it.

    Args:
        table: The table; columns that must not be cut are `no_wrap`.
        console: Where to print.
        num_heads: Columns that name a row.
    """
    from rich.measure import Measurement
    from rich.padding import Padding
    from rich.text import Text

    console = console or table_console()
    if Measurement.get(console, console.options.update(max_width=10_000), table).minimum <= console.width:
        console.print(table)
        return
    names = [str(column.header) for column in table.columns]
    rows = list(zip(*(column.cells for column in table.columns), strict=True))
    if table.title:
        console.print(Text(str(table.title), style="bold"))
    for cells in rows:
        texts = [cell.plain if isinstance(cell, Text) else str(cell) for cell in cells]
        if any(texts):
            console.print(Text(" ".join(texts[:num_heads]), style="bold"))
            for name, text in zip(names[num_heads:], texts[num_heads:], strict=True):
                console.print(Padding(Text(f"{name}: {text}"), (0, 0, 0, 2)))
