"""`openvima data info` and `verify`: what a folder of demonstrations holds, and whether it is whole."""

import contextlib
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

from openvima.cli.options import Folder, Json
from openvima.cli.terminal import print_table, progress_bar

if TYPE_CHECKING:
    from rich.table import Table

    from openvima.data.verification import Verification

_BAR_WIDTH = 40


def info(
    folder: Folder,
    *,
    details: bool = False,
    as_json: Json = False,
) -> None:
    """Print counts, sizes, histograms and provenance of a folder of demonstrations.

    Example: openvima data info demos --details

    Args:
        folder: Folder of a data set, or hf://OWNER/NAME[@REVISION] on the Hugging Face Hub,
            of which without details only the index is fetched.
        details: Count objects, textures and prompt images too; reads every file.
        as_json: Print everything as JSON.
    """
    from openvima.data.reader import data_folder
    from openvima.data.summary import summarise_folder
    from openvima.hub import dataset_name

    name = dataset_name(folder)
    index_only = name is not None and not details
    local = data_folder(folder, shards=not index_only)
    with progress_bar("files") if details else contextlib.nullcontext() as report:
        record = summarise_folder(local, index_only=index_only, details=details, report=report)
    if as_json:
        print(json.dumps(record, indent=2, ensure_ascii=False))
    else:
        for line in _summary(record, f"hf://{name.repo}@{local.name}" if name else str(folder)):
            print(_printable(line)) if isinstance(line, str) else print_table(line)
        if not details:
            print("\n--details counts objects, textures and prompt images too.")


def _printable(line: str) -> str:
    """A line whose quotes of a manifest of others cannot act on the terminal."""
    from openvima.errors import echo

    return echo(line, len(line))


def _summary(manifest: dict[str, Any], name: str) -> "Iterator[str | Table]":
    summary = manifest["summary"]
    counts, versions = manifest["counts"], manifest["versions"]
    yield (
        f"{name}: {counts['episodes']:,} episodes, {counts['steps']:,} steps, "
        f"{counts['shards']:,} shards, {summary['file_bytes'] / 1e6:,.1f} MB"
    )
    yield f"written by {manifest['command']}{_settings(manifest['config'])}"
    yield ", ".join(f"{name} {versions[name]}" for name in sorted(versions))
    yield f"finished; content {manifest['content_hash']}, licence {manifest['licence']}"
    for name, size in summary["object_caches"].items():
        yield f"object cache {name}: {size / 1e6:,.1f} MB"
    yield ""
    yield _task_table(summary["tasks"])
    for title, counts in summary["histograms"].items():
        if len(counts) > 1:
            yield ""
            yield title
            yield from _bars(counts)


def _settings(config: dict[str, Any]) -> str:
    """Format scalar settings in one line."""
    plain = {name: value for name, value in config.items() if isinstance(value, str | int | float | bool)}
    return "".join(f", {name.replace('_', ' ')} {value}" for name, value in sorted(plain.items()))


def _task_table(tasks: dict[str, dict[str, Any]]) -> "Table":
    from rich.markup import escape
    from rich.table import Table

    table = Table("task", box=None, pad_edge=False, header_style="")
    for name in ("episodes", "steps", "kB/episode", "seeds tried", "oracle success", "resamples"):
        table.add_column(name, justify="right", no_wrap=True)
    table.columns[0].no_wrap = True
    for task, entry in tasks.items():
        table.add_row(
            escape(_printable(task)),
            f"{entry['episodes']:,}",
            f"{entry['steps']:,}",
            f"{entry['bytes'] / entry['episodes'] / 1e3:.1f}",
            f"{entry['seeds_tried']:,}",
            f"{entry['success_rate']:.1%}",
            f"{entry['redraws']:,}",
        )
    return table


def _bars(counts: dict[str, int]) -> Iterator[str]:
    width, total, most = max(map(len, counts)), sum(counts.values()), max(counts.values())
    for label, count in counts.items():
        bar = f"{'█' * max(1, round(_BAR_WIDTH * count / most))} {count:,} ({count / total:.1%})"
        yield f"  {label:>{width}}  {bar}".rstrip()


def verify(
    folder: Folder,
    *,
    replay: int | Literal["all"] = 1,
    workers: int = 1,
    seed: int = 0,
    assets: str | None = None,
    as_json: Json = False,
) -> int:
    """Verify demonstrations: checksums, schema, values, and replayed episodes.

    Exit status 0 if there are no problems, else 1. Problems are listed with file, cause and remedy.

    Example: openvima data verify demos --workers 2

    Args:
        folder: Folder of demonstrations, or hf://OWNER/NAME[@REVISION] on the Hugging Face Hub.
        replay: Episodes of each task to replay in the simulator and compare bit by bit, or "all".
        workers: Number of processes.
        seed: Decides which episodes are replayed.
        assets: Folder of the original benchmark's assets, or FILE.py:FUNCTION, for data made with them.
        as_json: Print the result as JSON.

    Returns:
        Exit status.
    """
    from openvima.data.reader import data_folder
    from openvima.data.verification import VerifyConfig
    from openvima.data.verification import verify as verify_folder

    folder = data_folder(folder)
    config = VerifyConfig(None if replay == "all" else replay, seed=seed, assets=assets, workers=workers)
    with progress_bar("verifying") as report:
        found = verify_folder(folder, config, report)
    if as_json:
        print(json.dumps(found.record(), indent=2, ensure_ascii=False))
    else:
        print("\n".join(_text(found)))
    return 0 if found.is_clean else 1


def _text(found: "Verification") -> Iterator[str]:
    yield (
        f"{found.folder}: {found.num_shards:,} shards, {found.num_episodes:,} episodes compared with their "
        f"hashes, {found.num_replayed:,} replayed"
    )
    yield from (f"note: {note}" for note in found.notes)
    count = len(found.problems)
    yield "no problems" if found.is_clean else f"{count} problem{'s' * (count > 1)}"
    for problem in found.problems:
        yield f"  {problem.file}: {problem.cause}"
    yield from (f"  → {remedy}" for remedy in sorted({problem.remedy for problem in found.problems}))
