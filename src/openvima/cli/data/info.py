"""`openvima data info`: what a folder of demonstrations holds."""

import contextlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from openvima.cli.progress import progress_bar

if TYPE_CHECKING:
    from openvima.data.summary import Histogram, Overview, Unfinished

_BAR_WIDTH = 40
_MOST_BARS = 12  # histograms with more are cut to their ends
_NUM_AT_END = 5


def info(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    *,
    details: bool = False,
    html: Path | None = None,
    samples: int = 3,
    looks: Path | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Show what a folder of demonstrations holds: counts, sizes, histograms, and what made it.

    Example: openvima data info demos --html demos.html

    Args:
        folder: Folder that holds a data set, or what an interrupted command has left of one.
        details: Count objects, textures and prompt images too, for which every file is read.
        html: Write a page with all of this and episodes to look at; it needs nothing else.
        samples: Episodes of each task on that page.
        looks: Write which objects are shown in which textures, by task and role, to this JSON file, and say
            whether that goes beyond the training partition; every file is read.
        as_json: Print everything for machines.

    Returns:
        Exit status.
    """
    from openvima.data.summary import Unfinished, look_at
    from openvima.errors import ConfigError, DatasetError

    if html is not None and html.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"--html is {str(html)!r}; give the name of an HTML file, such as demos.html.")
    with progress_bar("files") if details or html else contextlib.nullcontext() as report:
        overview = look_at(folder, details=details or html is not None, report=report)
    if isinstance(overview, Unfinished) and (html is not None or looks is not None):
        raise DatasetError(f"{folder} is not finished; repeat the command that writes it.")
    if html is not None and not isinstance(overview, Unfinished):
        from openvima.data.page import write_page

        with progress_bar("episodes") as report:
            write_page(overview, html, num_samples=samples, report=report)
    if looks is not None:
        _write_looks(folder, looks)
    if as_json:
        print(json.dumps(overview.to_record(), indent=2, ensure_ascii=False))
    elif isinstance(overview, Unfinished):
        print("\n".join(_unfinished(overview)))
    else:
        print("\n".join([*_summary(overview), *_hints(details or html is not None, html)]))
    return 0


def _write_looks(folder: Path, file: Path) -> None:
    """Write which looks there are, and say on standard error whether training may show them."""
    from openvima.atomic_io import atomic_write_file
    from openvima.data.appearance_stats import looks_record, looks_text
    from openvima.data.leakage import beyond_training
    from openvima.data.reader import Dataset

    with progress_bar("files") as report:
        record = looks_record(Dataset(folder), report)
    atomic_write_file(file, looks_text(record))
    problems = beyond_training(record)
    for problem in problems[:_NUM_AT_END]:
        print(f"beyond the training partition: {problem}", file=sys.stderr)
    if len(problems) > _NUM_AT_END:
        print(f"… and {len(problems) - _NUM_AT_END:,} more", file=sys.stderr)
    if not problems:
        print(f"{file}: nothing is beyond the training partition", file=sys.stderr)


def _summary(overview: "Overview") -> Iterator[str]:
    manifest = overview.manifest
    counts, versions = manifest["counts"], manifest["versions"]
    yield (
        f"{overview.folder}: {counts['episodes']:,} episodes, {counts['steps']:,} steps, "
        f"{counts['shards']:,} shards, {overview.file_bytes / 1e6:,.1f} MB"
    )
    yield f"made by {manifest['command']}{_settings(manifest['config'])}"
    yield ", ".join(f"{name} {versions[name]}" for name in sorted(versions))
    yield f"finished; content {manifest['content_hash']}, licence {manifest['licence']}"
    if overview.num_failed is not None:
        yield f"failed/ keeps {overview.num_failed:,} episodes that the oracle did not solve"
    for name, size in overview.object_caches.items():
        yield f"object cache {name}: {size / 1e6:,.1f} MB"
    yield ""
    yield from _task_table(overview)
    for histogram in overview.histograms:
        if len(histogram.counts) > 1:
            yield ""
            yield from _bars(histogram)


def _settings(config: dict[str, Any]) -> str:  # Any: JSON
    """The plain settings in one line; names of tasks and whole sources would be too long for it."""
    plain = {name: value for name, value in config.items() if isinstance(value, str | int | float | bool)}
    return "".join(f", {name.replace('_', ' ')} {_shown(value)}" for name, value in sorted(plain.items()))


def _shown(value: object) -> str:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def _task_table(overview: "Overview") -> Iterator[str]:
    yield (
        f"{'task':<28}{'episodes':>10}{'steps':>10}{'kB/episode':>12}{'images':>8}"
        f"{'seeds tried':>13}{'oracle success':>16}{'redraws':>10}"
    )
    for task in overview.tasks:
        yield (
            f"{task.task:<28}{task.episodes:>10,}{task.steps:>10,}{task.bytes / task.episodes / 1e3:>12.1f}"
            f"{task.image_share:>8.0%}{task.seeds_tried:>13,}{task.success_rate:>16.1%}{task.redraws:>10,}"
        )


def _bars(histogram: "Histogram") -> Iterator[str]:
    yield histogram.title
    total, most = sum(histogram.counts.values()), max(histogram.counts.values())
    width = max(map(len, histogram.counts))
    entries = list(histogram.counts.items())
    left_out = len(entries) - 2 * _NUM_AT_END if len(entries) > _MOST_BARS else 0
    for place, (label, count) in enumerate(entries):
        if left_out and place == _NUM_AT_END:
            yield f"  {'':>{width}}  … {left_out} more …"
        if not left_out or not _NUM_AT_END <= place < len(entries) - _NUM_AT_END:
            bar = "█" * max(1, round(_BAR_WIDTH * count / most))
            yield f"  {label:>{width}}  {bar} {count:,} ({count / total:.1%})"


def _hints(has_details: bool, html: Path | None) -> Iterator[str]:
    if html is not None:
        yield f"\nPage: {html}"
    elif not has_details:
        yield "\n--details counts objects, textures and prompt images too; --html FILE shows episodes."


def _unfinished(overview: "Unfinished") -> Iterator[str]:
    yield (
        f"{overview.folder}: not finished; {sum(overview.episodes.values()):,} episodes "
        f"in {overview.shards:,} whole shards so far"
    )
    for task, episodes in overview.episodes.items():
        yield f"{task:<28}{episodes:>10,}"
    for name in overview.damaged:
        yield f"{name} cannot be read"
    yield "Repeating the command that wrote it goes on from there."
