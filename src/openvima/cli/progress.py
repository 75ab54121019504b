"""Progress on stderr: bars for `report(done, total, note)` callbacks, and a table for generating."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

    from openvima.data import GenerationProgress

Report = Callable[[int, int, str], None]
LINES = 10  # of progress, where stderr is no terminal
REDRAW_S = 0.25


@contextmanager
def progress_bar(label: str) -> Iterator[Report]:
    """Show one bar with count, time taken and time left while the block runs; nothing if nothing is done.

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
    console = Console(stderr=True)
    progress = Progress(*columns, console=console, refresh_per_second=4, expand=True)
    task = progress.add_task(label, total=None, note="")
    has_begun = False

    def report(done: int, total: int, note: str) -> None:
        nonlocal has_begun
        if not has_begun:
            progress.start()
            has_begun = True
        progress.update(task, completed=done, total=total, note=note)

    if console.is_terminal:
        progress.start()
    try:
        yield report
    finally:
        if not has_begun:  # what follows, mostly an error, says it all
            progress.update(task, visible=False)
            progress.live.transient = True
        if has_begun or console.is_terminal:  # else even stopping would print a line
            progress.stop()


@contextmanager
def generation_table() -> Iterator[Callable[["GenerationProgress"], None]]:
    """Show how far generating is: rate, time left, and a line a task; a few plain lines if nobody watches.

    Yields:
        A callback for `openvima.data.generate`.
    """
    from rich.console import Console
    from rich.live import Live

    console = Console(stderr=True)
    pace = Pace()
    if not console.is_terminal:
        yield _plain_lines(console.file.write, pace)
        console.file.flush()
        return
    with Live(console=console, auto_refresh=False) as live:
        drawn_s = 0.0

        def report(progress: "GenerationProgress") -> None:
            nonlocal drawn_s
            pace.update(progress.written)
            is_last = progress.done == progress.total
            if is_last or time.monotonic() - drawn_s >= REDRAW_S:
                drawn_s = time.monotonic()
                live.update(table_of(progress, pace), refresh=True)

        yield report


class Pace:
    """Episodes a second since the first one, which leaves out the start of the workers.

    Args:
        clock: Returns the time in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._first: tuple[float, int] | None = None
        self.rate: float | None = None

    def update(self, written: int) -> None:
        """Take note of the number of episodes written so far."""
        if written and self._first is None:
            self._first = (self._clock(), written)
        elif self._first is not None:
            seconds, episodes = self._clock() - self._first[0], written - self._first[1]
            if seconds > 0 and episodes > 0:
                self.rate = episodes / seconds

    def summary(self, progress: "GenerationProgress") -> str:
        """Describe in a line how far it is."""
        share = f"{progress.done:,} of {progress.total:,} ({100 * progress.done // progress.total} %)"
        if self.rate is None:
            return share
        num_left = progress.total - progress.done
        left = f", {_duration(num_left / self.rate)} left" if num_left else ""
        return f"{share}, {self.rate:.1f} episodes/s{left}"


def _plain_lines(write: Callable[[str], object], pace: Pace) -> Callable[["GenerationProgress"], None]:
    shown = -1

    def report(progress: "GenerationProgress") -> None:
        nonlocal shown
        pace.update(progress.written)
        part = LINES * progress.done // progress.total
        if part > shown:
            shown = part
            solved = (
                f", {_percent(progress.written, progress.tried)} of the seeds solved"
                if progress.tried
                else ""
            )
            write(f"demonstrations: {pace.summary(progress)}{solved}\n")

    return report


def table_of(progress: "GenerationProgress", pace: Pace) -> "Table":
    """Draw a line a task; 17 of them fit a terminal of 80 columns and 24 lines."""
    from rich.table import Table

    table = Table(title=pace.summary(progress), title_justify="left", box=None, pad_edge=False)
    table.add_column("task", no_wrap=True)
    for name in ("done", "of", "solved", "redraws"):
        table.add_column(name, justify="right", no_wrap=True)
    for task in progress.tasks:
        counts = (
            f"{task.done:,}",
            f"{task.total:,}",
            _percent(task.written, task.tried),
            f"{task.redraws:,}",
        )
        table.add_row(task.task, *counts)
    return table


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else ""


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
