"""Progress bars on stderr for the library's `report(done, total, note)` callbacks."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Report = Callable[[int, int, str], None]


@contextmanager
def progress_bar(label: str) -> Iterator[Report]:
    """Show one bar with count, time taken and time left while the block runs.

    Args:
        label: What is being done, in a word or two.

    Yields:
        A callback `report(done, total, note)`; the note ends the line and is cut where the line ends.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column

    columns = (
        TextColumn("{task.description}", table_column=Column(no_wrap=True, min_width=18)),
        BarColumn(bar_width=16),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        TimeRemainingColumn(compact=True, table_column=Column(no_wrap=True)),
        TextColumn("left", table_column=Column(no_wrap=True)),
        TextColumn("{task.fields[note]}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)),
    )
    with Progress(*columns, console=Console(stderr=True), refresh_per_second=4, expand=True) as progress:
        task = progress.add_task(label, total=None, note="")

        def report(done: int, total: int, note: str) -> None:
            progress.update(task, completed=done, total=total, note=note)

        try:
            yield report
        except BaseException:
            if progress.tasks[0].total is None:  # nothing had begun: the message that follows says it all
                progress.update(task, visible=False)
            raise
