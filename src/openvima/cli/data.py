"""`openvima data`: look into demonstrations, check them, and make others of them."""

import contextlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from openvima.cli.terminal import (
    Folder,
    Json,
    Out,
    Repository,
    parse_list,
    parse_tasks,
    print_files,
    print_table,
    progress_bar,
)
from openvima.data.chat_settings import DEFAULT_ENLARGE, ChatView, Points
from openvima.errors import ConfigError, echo

if TYPE_CHECKING:
    from rich.table import Table

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
            # A manifest of others must not act on the terminal.
            print(echo(line, len(line))) if isinstance(line, str) else print_table(line)
        if not details:
            print("\n--details counts objects, textures and prompt images too.")


def _summary(manifest: dict[str, Any], name: str) -> "Iterator[str | Table]":
    from rich.markup import escape
    from rich.table import Table

    summary = manifest["summary"]
    counts, versions = manifest["counts"], manifest["versions"]
    yield (
        f"{name}: {counts['episodes']:,} episodes, {counts['steps']:,} steps, "
        f"{counts['shards']:,} shards, {summary['file_bytes'] / 1e6:,.1f} MB"
    )
    config = {n: v for n, v in manifest["config"].items() if isinstance(v, str | int | float | bool)}
    settings = "".join(f", {name.replace('_', ' ')} {value}" for name, value in sorted(config.items()))
    yield f"written by {manifest['command']}{settings}"
    yield ", ".join(f"{name} {versions[name]}" for name in sorted(versions))
    yield f"finished; content {manifest['content_hash']}, licence {manifest['licence']}"
    for name, size in summary["object_caches"].items():
        yield f"object cache {name}: {size / 1e6:,.1f} MB"
    yield ""
    table = Table("task", box=None, pad_edge=False, header_style="")
    for name in ("episodes", "steps", "kB/episode", "seeds tried", "oracle success", "resamples"):
        table.add_column(name, justify="right", no_wrap=True)
    table.columns[0].no_wrap = True
    for task, entry in summary["tasks"].items():
        table.add_row(
            escape(echo(task, len(task))),
            f"{entry['episodes']:,}",
            f"{entry['steps']:,}",
            f"{entry['bytes'] / entry['episodes'] / 1e3:.1f}",
            f"{entry['seeds_tried']:,}",
            f"{entry['success_rate']:.1%}",
            f"{entry['redraws']:,}",
        )
    yield table
    for title, counts in summary["histograms"].items():
        if len(counts) > 1:
            yield ""
            yield title
            width, total, most = max(map(len, counts)), sum(counts.values()), max(counts.values())
            for label, count in counts.items():
                bar = f"{'█' * max(1, round(_BAR_WIDTH * count / most))} {count:,} ({count / total:.1%})"
                yield f"  {label:>{width}}  {bar}"


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
        return 0 if found.is_clean else 1
    print(
        f"{found.folder}: {found.num_shards:,} shards, {found.num_episodes:,} episodes compared with their "
        f"hashes, {found.num_replayed:,} replayed"
    )
    for note in found.notes:
        print(f"note: {note}")
    count = len(found.problems)
    print("no problems" if found.is_clean else f"{count} problem{'s' * (count > 1)}")
    for problem in found.problems:
        print(f"  {problem.file}: {problem.cause}")
    for remedy in sorted({problem.remedy for problem in found.problems}):
        print(f"  → {remedy}")
    return 0 if found.is_clean else 1


def sample(
    folder: Folder,
    out: Out,
    *,
    fraction: float | None = None,
    episodes: int | None = None,
    tasks: str = "all",
    seed: int = 0,
    workers: int = 1,
    force: bool = False,
) -> None:
    """Sample a fraction, or a number, of the demonstrations of each task.

    Samples of one seed are nested: the 1 % sample is a subset of the 10 % sample. Nothing in a demonstration
    is changed.

    Example: openvima data sample demos demos-1-percent --fraction 0.01

    Args:
        folder: The source.
        out: Folder to write to.
        fraction: Above 0, at most 1; at least one episode of each task is taken.
        episodes: Instead of a fraction: so many episodes of each task, or all that it has.
        tasks: Comma-separated names of tasks, or "all".
        seed: Seed of the sample.
        workers: Number of processes.
        force: Replace a data set in the folder.
    """
    from openvima.data.subsets import SubsetConfig
    from openvima.data.subsets import sample as write_sample

    config = SubsetConfig(folder, out, parse_tasks(tasks), seed, workers, force)
    with progress_bar("demonstrations") as report:
        print(write_sample(config, fraction, episodes=episodes, report=report))


def split(
    folder: Folder,
    out: Out,
    *,
    splits: str,
    tasks: str = "all",
    seed: int = 0,
    workers: int = 1,
    force: bool = False,
) -> None:
    """Divide demonstrations into splits, such as for training and validation.

    Each episode is assigned to one split by a hash and stays there when episodes are added. Sizes therefore
    match the fractions approximately.

    Example: openvima data split demos divided --splits training=0.923,validation=0.077

    Args:
        folder: The source.
        out: Folder to write to, with one data set per split.
        splits: Comma-separated NAME=FRACTION pairs; the fractions add up to 1.
        tasks: Comma-separated names of tasks, or "all".
        seed: Seed of the assignment.
        workers: Number of processes.
        force: Replace data sets in the folder.
    """
    from openvima.data.subsets import SubsetConfig, parse_splits
    from openvima.data.subsets import split as write_split

    config = SubsetConfig(folder, out, parse_tasks(tasks), seed, workers, force)
    fractions = parse_splits(splits)
    with progress_bar("demonstrations") as report:
        written = write_split(config, fractions, report=report)
    for name in fractions:
        print(written / name)


def merge(
    folders: Annotated[tuple[Path, ...], Positional, arg(metavar="FOLDER… OUT")],
    *,
    tasks: str = "all",
    duplicates: Literal["refuse", "skip"] = "refuse",
    workers: int = 1,
    force: bool = False,
) -> None:
    """Merge data sets, whatever their tasks, levels, settings and versions.

    Example: openvima data merge rotations stacks all-demos

    Args:
        folders: The sources, and last the folder to write to.
        tasks: Comma-separated names of tasks, or "all".
        duplicates: Refuse episodes that several sources contain, or skip all but one.
        workers: Number of processes.
        force: Replace a data set in the folder.
    """
    from openvima.data.subsets import MergeConfig
    from openvima.data.subsets import merge as write_merged

    if len(folders) < 2:
        raise ConfigError("give at least two folders: what to merge, and last where to write it.")
    config = MergeConfig(folders[:-1], folders[-1], parse_tasks(tasks), duplicates, workers, force)
    with progress_bar("demonstrations") as report:
        print(write_merged(config, report=report))


def import_published(
    source: Annotated[Path, Positional, arg(metavar="SOURCE")],
    out: Out,
    *,
    tasks: str = "all",
    episodes: int | None = None,
    compression: Literal["lz4", "zstd"] = "zstd",
    workers: int = 1,
    force: bool = False,
) -> None:
    """Convert the demonstrations that the benchmark's authors published; docs/published_data.md says how.

    The zip archive is read where it is, without unpacking it, and nothing in it is run. Broken episodes are
    left out and named in OUT/broken.json. Repeating a command that was interrupted continues it.

    Example: openvima data import vima.zip published --workers 2

    Args:
        source: The zip archive, or a folder with unpacked episodes.
        out: Folder to write to.
        tasks: Old or new names of tasks with commas between them, or "all".
        episodes: At most so many episodes of each task, the first ones; by default all.
        compression: Codec of the files; lz4 takes twice the space and is read faster.
        workers: Number of processes.
        force: Delete the data set that is in OUT.
    """
    from openvima.data.manifest import BROKEN_NAME
    from openvima.data.published import ImportConfig
    from openvima.data.published import import_published as convert

    config = ImportConfig(
        source=source,
        out=out,
        tasks=parse_list(tasks),
        episodes=episodes,
        compression=compression,
        workers=workers,
        force=force,
    )
    with progress_bar("episodes") as report:
        folder = convert(config, report)
    if (folder / BROKEN_NAME).is_file():
        first, *others = json.loads((folder / BROKEN_NAME).read_text(encoding="utf-8"))
        print(
            f"{1 + len(others)} left out, see {folder / BROKEN_NAME}; "
            f"first {first['member']}: {first['reason']}",
            file=sys.stderr,
        )
    print(folder)


def export_lerobot(
    folder: Folder,
    out: Out,
    *,
    tasks: str = "all",
    pixels: Literal["yuv444p", "yuv420p"] = "yuv444p",
    force: bool = False,
) -> None:
    """Export demonstrations to the LeRobotDataset v3.0 format; docs/lerobot.md says what is in it.

    Example: openvima data export-lerobot demos demos_lerobot --tasks rotate,twist

    Args:
        folder: Folder of demonstrations.
        out: Folder of the export.
        tasks: Names of tasks with commas between them, or "all".
        pixels: yuv444p keeps colours within 2 of 255 levels; yuv420p is what browsers and graphics cards
            play, at half the resolution of colours.
        force: Replace the export that is in OUT.
    """
    from openvima.data.lerobot import LerobotConfig, export_lerobot

    config = LerobotConfig(
        data=folder,
        out=out,
        tasks=parse_tasks(tasks),
        pixels=pixels,
        force=force,
    )
    with progress_bar("export") as report:
        export_lerobot(config, report)
    print(f'LeRobotDataset("local/{out.name}", root="{out}") opens it in LeRobot.', file=sys.stderr)
    print(out)


def export_chat(
    folder: Folder,
    out: Out,
    *,
    format: Literal["messages", "llava"] = "messages",
    tasks: str = "all",
    view: ChatView = "top",
    points: Points = "1000-xy",
    enlarge: int = DEFAULT_ENLARGE,
    boxes: str = "",
    questions: int = 0,
    seed: int = 0,
) -> None:
    """Export demonstrations as conversations for the fine-tuning of a vision-language model.

    An example is a step: what `openvima evaluate --policy vlm:MODEL` asks before it, in the same words, and
    the oracle's answer. docs/vlms.md says how to train on it.

    Example: openvima data export-chat demos chats --format messages --questions 2

    Args:
        folder: Folder of demonstrations.
        out: Folder of the export: train.jsonl, and PNG files in images.
        format: messages: roles and contents, as TRL reads them; llava: conversations with <image>.
        tasks: Names of tasks with commas between them, or "all".
        view: Camera that is shown, and in whose picture points lie; top+front shows both.
        points: Largest number of a point (1000, 1, or pixels) and order.
        enlarge: Whole factor on images, without smoothing.
        boxes: List boxes of the objects in the text: segmentation; detector, the bundled one, or
            MODULE:FUNCTION.
        questions: Auxiliary questions for each demonstration: where an object is, which there are, how two
            lie to each other, what was moved.
        seed: Of the choice of questions.
    """
    from openvima.data.chat import ChatFormat
    from openvima.data.chat_export import export_chat as write_export
    from openvima.detector.plugins import chat_extractor

    with progress_bar("export") as report:
        written = write_export(
            folder,
            out,
            format=format,
            tasks=parse_tasks(tasks),
            form=ChatFormat(points, view, enlarge),
            extractor=chat_extractor(boxes),
            questions=questions,
            seed=seed,
            report=report,
        )
    print(written)


def preprocess(
    folder: Folder,
    *,
    kind: Literal["objects", "frames"] = "objects",
    boxes: str | None = None,
    fraction: float = 1.0,
    rerendered: int | None = None,
    out: Path | None = None,
    workers: int = 1,
) -> None:
    """Write the object cache of a folder of demonstrations, or the shards that it lacks.

    The cache holds the inputs of policies: crops and boxes of all objects, or whole frames at half the size.
    `openvima train` writes it when it is missing; beforehand, several processes can share the work. It may be
    deleted at any time. An interrupted command resumes after the last whole shard.

    Example: openvima data preprocess demos --workers 2

    Args:
        folder: Folder of demonstrations.
        kind: objects for presets with object tokens, frames for gato, flamingo and gpt.
        boxes: Detector that extracts the objects, for `openvima train --loader.boxes`: "detector" for the
            bundled one, detector=FOLDER for one trained with `openvima detector train`, or MODULE:FUNCTION or
            FILE.py:FUNCTION, which returns an ObjectExtractor. Default: the segmentation.
        fraction: Fraction of the demonstrations in which `boxes` detects objects, for `openvima train
            --loader.detected-fraction`.
        rerendered: Number of a random appearance, from 0, to render the demonstrations again with, for
            `openvima train --loader.rerendered-prob`. Default: as they are stored.
        out: Folder of the cache; default: "object_cache" in the folder of demonstrations.
        workers: Number of processes.
    """
    from openvima.data.object_cache import open_object_cache
    from openvima.data.reader import Dataset
    from openvima.detector.plugins import detected_object_cache, plugged_boxes

    if rerendered is not None and (boxes is not None or rerendered < 0):
        raise ConfigError(f"rerendered is {rerendered}; it must be 0 or more, and without --boxes.")
    if not 0 <= fraction <= 1 or (fraction < 1 and boxes is None):
        raise ConfigError(
            f"fraction is {fraction:g}; it must lie between 0 and 1, and needs --boxes below 1."
        )
    dataset = Dataset(folder)
    options = {"kind": kind, "folder": out, "workers": workers}
    with progress_bar("object cache") as report:
        if boxes is None:
            cache = open_object_cache(dataset, **options, appearance=rerendered, report=report)
        else:
            found = plugged_boxes(boxes, fraction=fraction)
            cache = detected_object_cache(dataset, found, **options, report=report)
    print(f"the object cache of {len(cache):,} demonstrations is ready.", file=sys.stderr)
    print(cache.folder)


def push_to_hub(
    folder: Folder,
    name: Repository,
    *,
    private: bool = False,
    dry_run: bool = False,
) -> None:
    """Push demonstrations to the Hugging Face Hub, with a generated dataset card.

    The token is that of `hf auth login` or HF_TOKEN. Failed episodes and object caches are not pushed.

    Example: openvima data push-to-hub demos owner/demos

    Args:
        folder: Folder of demonstrations.
        name: The repository, as OWNER/NAME or OWNER/NAME@BRANCH; it is created if there is none.
        private: Make a new repository private.
        dry_run: Print the card and list the files; nothing is sent.
    """
    from openvima.publishing import demonstrations_files, push_demonstrations

    if dry_run:
        print_files(demonstrations_files(folder, name))
    else:
        print(f"hf://{push_demonstrations(folder, name, private=private)}")


COMMANDS = {
    "info": info,
    "verify": verify,
    "merge": merge,
    "sample": sample,
    "split": split,
    "import": import_published,
    "preprocess": preprocess,
    "export-lerobot": export_lerobot,
    "export-chat": export_chat,
    "push-to-hub": push_to_hub,
}
