"""What commands read and print: options of several of them, streams of any encoding, progress, tables.

Progress is shown on stderr: bars for `report(done, total, note)` callbacks. Where stderr is no terminal,
these are lines: one at the start, one a minute and one at the end.
"""

import os
import re
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from openvima.errors import ConfigError
from openvima.multiprocess import Report

Folder = Annotated[Path, Positional, arg(metavar="FOLDER")]
Out = Annotated[Path, Positional, arg(metavar="OUT")]
Policy = Annotated[str, Positional, arg(metavar="POLICY")]
Repository = Annotated[str, Positional, arg(metavar="OWNER/NAME")]
Task = Annotated[str | None, Positional, arg(metavar="TASK")]
Json = Annotated[bool, arg(name="json")]


@dataclass(frozen=True, slots=True)
class EnvironmentOptions:
    """Tasks, prompts and control.

    Args:
        assets: procedural, original (see `openvima assets import`), a checkout of the original benchmark,
            or FILE.py:FUNCTION, which registers assets of your own.
        compat: Reproduce the quirks of the original benchmark; docs/compat.md lists them.
        prompts: multimodal; text, which puts a description such as "the red swirl letter A" in place of each
            object image; or mixed, which does so with probability ½. With ",paraphrased": synonyms.
        task_options: Options of tasks, [TASK.]NAME=VALUE with commas between them, such as
            num_distractors=3,rotate.difficulty=hard; `openvima tasks NAME` lists them. Without a task, for
            all that have the option.
        control: primitives; or end_effector, where an action moves the tool for 0.1 s (see
            docs/end_effector.md), for policies of that control and the oracle.
    """

    assets: str = "procedural"
    compat: bool = False
    prompts: str = "multimodal"
    task_options: str = ""
    control: Literal["primitives", "end_effector"] = "primitives"


Environment = OmitArgPrefixes[EnvironmentOptions]
DEFAULT_ENVIRONMENT = EnvironmentOptions()


def parse_list(text: str) -> tuple[str, ...]:
    """Split an option such as "rotate,twist"."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def parse_tasks(text: str) -> tuple[str, ...] | None:
    """Split the names of tasks; None for "all"."""
    names = parse_list(text)
    return None if names == ("all",) else names


def parse_shard_range(text: str | None) -> tuple[int, int] | None:
    """Split a range such as "0:10".

    Raises:
        ConfigError: It is none, or empty.
    """
    if text is None:
        return None
    found = re.fullmatch(r"(\d+):(\d+)", text)
    if found is None or int(found[1]) >= int(found[2]):
        raise ConfigError(f"shard_range is {text!r}; it must be a:b with 0 ≤ a < b, such as 0:10.")
    return int(found[1]), int(found[2])


def refuse_existing(out: Path, *, force: bool) -> None:
    """Refuse to write a checkpoint where something is, unless it may be replaced.

    Raises:
        ConfigError: There is something.
    """
    if out.exists() and not force:
        raise ConfigError(f"{out} exists; give another folder, or --force to replace the checkpoint in it.")


LINE_S = 60.0  # between two lines, where stderr is no terminal


@contextmanager
def progress_bar(label: str) -> Iterator[Report]:
    """Show one bar with count, time taken and time left while the block runs; nothing if nothing is done.

    Args:
        label: What is being done, in a word or two.

    Yields:
        A callback `report(done, total, note)`; the note ends the line and is cut where the line ends.
    """
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield plain_lines(label)
        return
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
        "{task.description}",
        BarColumn(bar_width=16),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(compact=True),
        "left",
        TextColumn("{task.fields[note]}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)),
    )
    progress = Progress(*columns, console=console, refresh_per_second=4, expand=True)
    task = progress.add_task(label, total=None, note="")

    def report(done: int, total: int, note: str) -> None:
        progress.start()  # not before: what ends in an error at once shows no bar
        progress.update(task, completed=done, total=total, note=note)

    try:
        yield report
    finally:
        progress.stop()


def plain_lines(label: str) -> Report:
    """Return a progress callback that prints lines: at the start, once a minute, and at the end.

    Args:
        label: What is being done, in a word or two.

    Returns:
        A callback `report(done, total, note)`.
    """
    start: tuple[float, int] | None = None
    shown_s, is_ended = 0.0, False

    def report(done: int, total: int, note: str) -> None:
        nonlocal start, shown_s, is_ended
        now_s, was_ended, is_ended = time.monotonic(), is_ended, done == total
        if start is None:
            start = now_s, done
        elif now_s - shown_s < LINE_S and (was_ended or not is_ended):
            return
        shown_s, seconds, new = now_s, now_s - start[0], done - start[1]
        left = f", {timedelta(seconds=round(seconds / new * (total - done)))} left" if new > 0 else ""
        text = f"{label}: {done:,} of {total:,}{left}{f'; {note}' if note else ''}"
        print(text, file=sys.stderr, flush=True)

    return report


if TYPE_CHECKING:
    from rich.table import Table

    from openvima.report import table as report

PIPE_WIDTH = 150  # characters, where nothing says how wide the reader is


def rich_table(table: "report.Table") -> "Table":
    """Return a table of `openvima.report` for the terminal."""
    from rich.table import Table

    shown = Table(title=table.caption)
    for number, name in enumerate(table.columns):
        is_text = number == 0 or all(isinstance(line.cells[number - 1], str) for line in table.lines)
        justify, overflow = ("left", "fold") if is_text else ("right", "ellipsis")
        shown.add_column(name, justify=justify, overflow=overflow, no_wrap=not is_text)
    for line in table.lines:
        if line.starts_group:
            shown.add_section()
        cells = (cell if isinstance(cell, str) else cell.brief for cell in line.cells)
        shown.add_row(line.name, *cells)
    return shown


def print_left_out(tasks: Sequence[str], prompts: str, levels: Sequence[str]) -> None:
    """Say on stderr what a run leaves out: tasks whose prompts lack a text form, levels without its tasks."""
    from openvima.tasks.registry import named_tasks, task_spec, tasks_of
    from openvima.tasks.sampling import takes_prompts

    present = sorted({task for level in levels for task in tasks_of(level)})
    if "all" in tasks and (left_out := [task for task in present if not takes_prompts(task, prompts)]):
        print(f"Left out, since their prompts have no text form: {', '.join(left_out)}.", file=sys.stderr)
    held = {level for task in named_tasks(tasks) if task != "all" for level in task_spec(task).levels}
    empty = [level for level in levels if level not in held]
    if "all" not in tasks and 0 < len(empty) < len(levels):  # nothing to play at all is an error
        print(f"Left out, since they hold none of the tasks: {', '.join(empty)}.", file=sys.stderr)


def print_table(table: "Table", *, num_heads: int = 1) -> None:
    """Print a table, or a short paragraph for each row where the terminal is too narrow for it.

    A file or a pipe takes long lines.

    Args:
        table: The table; columns that must not be cut are `no_wrap`.
        num_heads: Columns that name a row.
    """
    from rich.console import Console
    from rich.measure import Measurement
    from rich.padding import Padding
    from rich.text import Text

    console = Console(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console = Console(width=PIPE_WIDTH)
    if Measurement.get(console, console.options.update(max_width=10_000), table).minimum <= console.width:
        console.print(table)
        return
    names = [str(column.header) for column in table.columns]
    if table.title:
        console.print(Text(str(table.title), style="bold"))
    for cells in zip(*(column.cells for column in table.columns), strict=True):
        texts = [cell.plain if isinstance(cell, Text) else str(cell) for cell in cells]
        if any(texts):
            console.print(Text(" ".join(texts[:num_heads]), style="bold"))
            for name, text in zip(names[num_heads:], texts[num_heads:], strict=True):
                console.print(Padding(Text(f"{name}: {text}"), (0, 0, 0, 2)))


def print_files(files: Mapping[str, Path | bytes]) -> None:
    """Print the card to stdout, and the names and sizes of all files to stderr."""
    from openvima.publishing import CARD_NAME

    for name, content in files.items():
        size = len(content) if isinstance(content, bytes) else content.stat().st_size
        print(f"{name}: {size:,} bytes", file=sys.stderr)
        if name == CARD_NAME and isinstance(content, bytes):
            print(content.decode(), end="")
