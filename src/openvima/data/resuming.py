"""What a folder already holds of the data set that is asked for, and what does not belong to it."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from openvima.atomic_io import NO_SPACE
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import (
    BROKEN_NAME,
    FAILED_FOLDER,
    INDEX_NAME,
    MANIFEST_NAME,
    PREVIOUS_NAME,
    check_failed,
)
from openvima.data.planning import COMMAND, Block, GenerateConfig
from openvima.data.reader import read_manifest
from openvima.data.shard import Shard
from openvima.env.config import ENV_SETTINGS
from openvima.errors import DatasetError, StorageError

FAILED_KINDS = ("failed", "unsolved")  # what the oracle tried and did not solve
_NAMES = (MANIFEST_NAME, INDEX_NAME, BROKEN_NAME, PREVIOUS_NAME)


def is_done(block: Block) -> bool:
    """Say whether a block's shard needs no work.

    A shard is whole if its name exists. It is written again if more episodes are asked for than when it was
    written, or if its failed episodes are wanted now and were not kept.
    """
    if not block.path.is_file():
        return False
    shard = Shard(block.path)
    if len(shard) != block.episodes:
        return False
    return block.failed_path is None or block.failed_path.is_file() or not _has_failed(shard)


def is_finished(folder: Path) -> bool:
    """Say whether a folder has its manifest and index, which are written last."""
    return (folder / MANIFEST_NAME).is_file() and (folder / INDEX_NAME).is_file()


def check_folder(config: GenerateConfig, blocks: Sequence[Block]) -> None:
    """Refuse a folder whose shards do not belong to the data set that is asked for.

    Raises:
        DatasetError: It holds shards of other settings or versions, or more episodes than are asked for.
        ShardError: A shard is damaged.
    """
    check_failed(config.out)
    _check_origin(config.out)
    wanted = {block.path.name: block for block in blocks}
    for path in sorted(config.out.glob("*.arrow")):
        shard = Shard(path)
        problems = _differences(shard.info, blocks[0].info)
        block = wanted.get(path.name)
        if block is None and not problems:
            problems = [_surplus(shard.info, config)]
        if block is not None and len(shard) > block.episodes:
            problems.append(f"it has {len(shard)} episodes, asked for are {block.episodes}")
        if problems:
            raise DatasetError(
                f"{path} belongs to another data set, or to a larger one: {'; '.join(problems)}. "
                "Give its settings, another --out, or --force to delete it."
            )
    failed = config.out / FAILED_FOLDER
    if not config.keep_failed and any(failed.glob("*.arrow")):
        raise DatasetError(
            f"{failed} holds the episodes that the oracle did not solve. "
            "Give --keep-failed to keep it up to date, or delete it."
        )


def clear(folder: Path) -> None:
    """Delete a data set, its failed episodes too; other files stay."""
    check_failed(folder)
    for part in (folder, folder / FAILED_FOLDER):
        for path in [*(part / name for name in _NAMES), *part.glob("*.arrow")]:
            path.unlink(missing_ok=True)


def remove_leftovers(folder: Path, shards: Iterable[Path] | None = None) -> None:
    """Delete what killed writers, perhaps on other machines, left in a folder that is locked.

    Args:
        folder: The data folder; its failed episodes count too.
        shards: The locked shards; None means the whole folder.
    """
    names = None if shards is None else {path.name for path in shards}
    for file in (*folder.glob(".*.tmp"), *(folder / FAILED_FOLDER).glob(".*.tmp")):  # .NAME.PROCESS.tmp
        name = file.name[1:].rsplit(".", 2)[0]
        if name in names if names is not None else name in _NAMES or name.endswith(".arrow"):
            file.unlink(missing_ok=True)


def storage_error(folder: Path, shards: Sequence[Path], error: OSError) -> StorageError:
    """Return the error to raise where a folder cannot be written to; it says how much of the work is kept.

    Args:
        folder: The data set's folder.
        shards: All its shards, written or not.
        error: What the system said.
    """
    num_there = sum(path.is_file() for path in shards)
    remedy = "Make room" if error.errno in NO_SPACE else "Make sure that it can be written to"
    return StorageError(
        f"cannot write to {folder}: {error.strerror or error}. {num_there} of {len(shards)} shards are "
        f"whole and were kept. {remedy}; the same command then goes on from there."
    )


def _check_origin(folder: Path) -> None:
    """Refuse what other commands made: shards of a sample say the same of themselves, with other episodes."""
    if not (folder / MANIFEST_NAME).is_file():
        return
    manifest = read_manifest(folder)
    if manifest["command"] != COMMAND or "kept" in manifest["config"]:
        raise DatasetError(
            f"{folder} belongs to another data set: `{manifest['command']}` made it. "
            "Give another --out, or --force to delete it."
        )


def _has_failed(shard: Shard) -> bool:
    rows = shard.table(["skipped"]).column("skipped").to_pylist()
    return any(skipped["kind"] in FAILED_KINDS for row in rows for skipped in row)


def _surplus(found: ShardInfo, config: GenerateConfig) -> str:
    if found.task in config.resolved_tasks():
        return f"it has episodes beyond the {config.episodes} a task that are asked for"
    return f"its task {found.task} is not asked for"


def _differences(found: ShardInfo, asked: ShardInfo) -> list[str]:
    names = ("level", "domain", "shard_size", "first_seed", *ENV_SETTINGS, "compression", "images")
    pairs = [(name, getattr(found, name), getattr(asked, name)) for name in names]
    pairs += [(name, found.versions.get(name), asked.versions[name]) for name in asked.versions]
    return [
        f"{name} is {str(there) or 'none'}, asked for is {str(here) or 'none'}"
        for name, there, here in pairs
        if there != here
    ]
