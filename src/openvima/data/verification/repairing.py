"""Repairing data sets: damaged shards are generated again, or rewritten with their whole records."""

import contextlib
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from openvima.atomic_io import folder_lock, naming
from openvima.catalog.packs import load_assets
from openvima.data.checksums import spans_of
from openvima.data.generation import finish
from openvima.data.manifest import CACHE_FOLDER, FAILED_FOLDER, fingerprint, finish_folder
from openvima.data.oracle_rollouts import write_block
from openvima.data.planning import COMMAND, Block, GenerateConfig, plan
from openvima.data.progress import NUM_COUNTS
from openvima.data.reader import read_manifest
from openvima.data.records import package_versions
from openvima.data.resuming import is_done
from openvima.data.shard import Shard
from openvima.data.verification.checks import DEFAULT, verify
from openvima.data.verification.findings import Report, Verification, VerifyConfig
from openvima.data.verification.inventory import Inventory, take_inventory
from openvima.data.verification.salvage import rewrite
from openvima.env.config import ENV_SETTINGS
from openvima.errors import DatasetError, OpenVimaError
from openvima.input_files import as_path
from openvima.multiprocess import Counts, imap_with_progress

_STAGING = ".repair.tmp"


@dataclass(frozen=True, slots=True)
class Repair:
    """Result of a repair.

    Args:
        before: Verification before the repair.
        after: Verification after it.
        regenerated: Shards that were generated again.
        rewritten: Shards whose whole records were kept.
        lost: Episodes that are gone, as the index describes them.
        deleted: Files of the object cache that did not match; they are made again when needed.
    """

    before: Verification
    after: Verification
    regenerated: tuple[str, ...] = ()
    rewritten: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    deleted: tuple[str, ...] = ()

    def record(self) -> dict[str, Any]:  # Any: JSON
        """Return everything as plain values."""
        did = {name: list(getattr(self, name)) for name in ("regenerated", "rewritten", "lost", "deleted")}
        return {**self.after.record(), "repaired": {"before": self.before.record(), **did}}


def repair(folder: str | Path, config: VerifyConfig = DEFAULT, report: Report | None = None) -> Repair:
    """Verify a data set, repair it, and verify it again.

    Damaged shards of a generated data set are generated again with the same bytes. Others are rewritten with
    their whole records. Index and manifest are then written anew. No whole record is lost, and a file is only
    replaced by a whole one.

    Args:
        folder: Folder of demonstrations.
        config: How thoroughly to verify the result, and the number of workers.
        report: Called with episodes done, episodes in all, and the current stage.

    Raises:
        DatasetError: There is no data set, or the installed versions cannot repair it.
        ShardError: A damaged shard has whole records that cannot be kept.
        FolderLockedError: Another process writes to the folder.
        WorkerError: A worker died; repeat the command.
    """
    folder = as_path(folder)
    if take_inventory(folder).holds_failed:
        raise DatasetError(f"{folder} belongs to {folder.parent}; repair that, and both are repaired.")
    with folder_lock(folder):
        return _repair(folder, config, report)


def _repair(folder: Path, config: VerifyConfig, report: Report | None) -> Repair:
    before = verify(folder, replace(config, replay=0), report)
    if before.is_clean:
        return Repair(before, verify(folder, config, report))
    deleted = sorted({p.file for p in before.problems if p.file.startswith(f"{CACHE_FOLDER}/")})
    for name in deleted:
        (folder / name).unlink(missing_ok=True)
    inventory = take_inventory(folder)
    origin = inventory.manifest or inventory.doubtful
    regenerated, rewritten, lost = (), (), ()
    if origin is None or origin["command"] == COMMAND:
        regenerated = _regenerate(inventory, before.damaged, config, report)
    else:
        rewritten, lost = _rewrite(inventory, origin, before.damaged)
    return Repair(before, verify(folder, config, report), regenerated, rewritten, lost, tuple(deleted))


def _regenerate(
    inventory: Inventory, damaged: Sequence[str], config: VerifyConfig, report: Report | None
) -> tuple[str, ...]:
    """Generate damaged and missing shards; they replace others once all are whole and known to be equal.

    Raises:
        DatasetError: They cannot be generated with the same bytes. Nothing was changed.
    """
    folder = inventory.folder
    settings, versions = _origin(inventory, damaged, config)
    blocks = plan(settings)
    wanted = [b for b in blocks if not _names(b).isdisjoint(damaged) or not is_done(b)]
    names = {name for block in wanted for name in _names(block)}
    if unknown := sorted(set(damaged) - names):
        raise DatasetError(f"by its settings, {folder} has no {unknown[0]}; nothing was changed.")
    written: list[str] = []
    if wanted:
        _check_versions(folder, versions, num_shards=len(wanted))
        checksums = {**_checksums(folder), **_checksums(folder / FAILED_FOLDER, f"{FAILED_FOLDER}/")}
        with _staging(folder) as staging:
            _write([_staged(block, staging) for block in wanted], config.workers, report)
            written = [name for name in sorted(names) if (staging / name).is_file()]
            for name in written:
                _check_bytes(staging / name, folder / name, checksums.get(name))
            for name in written:
                (folder / name).parent.mkdir(exist_ok=True)
                os.replace(staging / name, folder / name)
    finish(settings, [replace(b, info=replace(b.info, versions=dict(versions))) for b in blocks], reuse=False)
    return tuple(written)


def _origin(
    inventory: Inventory, damaged: Sequence[str], config: VerifyConfig
) -> tuple[GenerateConfig, Mapping[str, str]]:
    """Find the settings and versions that wrote a folder, in its manifest or else in its shards.

    Raises:
        DatasetError: The settings cannot be used today, or the shards do not agree on any.
    """
    if inventory.manifest is not None:
        try:
            settings = _settings(inventory.folder, inventory.manifest["config"], config)
        except (OpenVimaError, TypeError) as error:
            raise DatasetError(f"{inventory.folder} cannot be generated again: {error}") from None
        return settings, inventory.manifest["versions"]
    broken = {name for name in damaged if "/" not in name}
    whole = [Shard(inventory.folder / name) for name in inventory.shard_names() if name not in broken]
    records = [] if inventory.doubtful is None else [inventory.doubtful["config"]]  # knows of lost shards too
    for record in [*records, _record_of(whole)] if whole else ():
        with contextlib.suppress(OpenVimaError, TypeError):  # a task or an asset pack that is not installed
            settings = _settings(inventory.folder, record, config)
            if _fits(settings, whole, broken):
                return settings, whole[0].info.versions
    raise DatasetError(
        f"the manifest of {inventory.folder} is lost, and its shards are not those of one "
        "`openvima generate` command. Repeat the command that wrote it, or restore dataset.json from a copy."
    )


def _settings(folder: Path, record: Mapping[str, Any], config: VerifyConfig) -> GenerateConfig:  # Any: JSON
    keep_failed = any((folder / FAILED_FOLDER).glob("*"))
    if config.assets is not None and record.get("assets") != "procedural":
        load_assets(config.assets)  # may be a function: `from_record` runs none
        record = {**record, "assets": config.assets}
    return GenerateConfig.from_record(folder, record, keep_failed=keep_failed, workers=config.workers)


def _record_of(shards: Sequence[Shard]) -> dict[str, Any]:  # Any: JSON
    """Derive the settings of a folder from its shards, as a manifest holds them."""
    info, episodes = shards[0].info, Counter[str]()
    for shard in shards:
        episodes[shard.info.task] += len(shard)
    names = ("level", "shard_size", "compression", "images", *ENV_SETTINGS)
    counts = {"episodes": max(episodes.values()), "start_seed": info.first_seed}
    return {"tasks": sorted(episodes), **counts, **{name: getattr(info, name) for name in names}}


def _fits(settings: GenerateConfig, whole: Sequence[Shard], broken: set[str]) -> bool:
    """Whether all shards of a folder are among those that some settings give."""
    blocks = {block.path.name: block for block in plan(settings)}
    return blocks.keys() >= {*broken, *(shard.path.name for shard in whole)} and all(
        shard.info == replace(blocks[shard.path.name].info, versions=shard.info.versions)
        and len(shard) == blocks[shard.path.name].episodes
        for shard in whole
    )


def _names(block: Block) -> set[str]:
    return {block.path.name, f"{FAILED_FOLDER}/{block.path.name}"}


def _checksums(folder: Path, prefix: str = "") -> dict[str, str]:
    """Name to SHA-256 of the shards in a manifest; empty if it cannot be trusted."""
    try:
        shards = read_manifest(folder)["shards"]
    except DatasetError:
        return {}
    return {prefix + name: entry["sha256"] for name, entry in shards.items()}


def _check_versions(folder: Path, versions: Mapping[str, str], *, num_shards: int) -> None:
    others = [
        f"{name} {versions.get(name, 'of an unknown version')} (installed: {version})"
        for name, version in package_versions().items()
        if versions.get(name) != version
    ]
    if others:
        raise DatasetError(
            f"{num_shards} shards of {folder} must be generated again, which gives the same bytes only with "
            f"{', '.join(others)}. Install these versions and repeat the command; nothing was changed."
        )


def _check_bytes(written: Path, place: Path, sha256: str | None) -> None:
    """Refuse a shard whose bytes are not those in the manifest.

    A file in place that has them and is damaged was damaged before it was listed, so they prove nothing.
    """
    if sha256 is None or fingerprint(written)["sha256"] == sha256:
        return
    if not place.is_file() or fingerprint(place)["sha256"] != sha256:
        raise DatasetError(
            f"{place} was generated again, but not with the bytes that the manifest tells. "
            "Nothing was changed."
        )


@contextlib.contextmanager
def _staging(folder: Path) -> Iterator[Path]:
    staging = folder / _STAGING
    shutil.rmtree(staging, ignore_errors=True)  # of a repair that was killed
    try:
        with naming(folder, staging):
            staging.mkdir()
            yield staging
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _staged(block: Block, staging: Path) -> Block:
    failed = None if block.failed_path is None else staging / FAILED_FOLDER / block.path.name
    return replace(block, path=staging / block.path.name, failed_path=failed)


def _write(blocks: Sequence[Block], num_workers: int, report: Report | None) -> None:
    total = sum(block.episodes for block in blocks)

    def watch(counts: Counts) -> None:
        if report is not None:
            report(sum(row[0] for row in counts), total, "generating again")

    for _ in imap_with_progress(write_block, blocks, num_workers, num_counts=NUM_COUNTS, watch=watch):
        pass  # a block's result is its file


def _rewrite(
    inventory: Inventory,
    origin: Mapping[str, Any],  # Any: JSON
    damaged: Sequence[str],
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Keep the whole records of damaged shards; return rewritten shards and lost episodes."""
    parts, lost = inventory.index_parts(), []
    for name in damaged:
        part = parts.get(name)
        kept = rewrite(inventory.folder / name, None if part is None else spans_of(part))
        if part is None:  # nothing tells which episodes they were
            lost.append(f"what {name} held besides {len(kept)} whole records")
            continue
        lost += [
            f"{row['task']} {row['level']} seed {row['seed']} ({name}, record {row['row']})"
            for row in part.to_pylist()
            if row["content_hash"] not in kept
        ]
    is_there = {name: (inventory.folder / name).is_file() for name in (*inventory.shard_names(), *damaged)}
    finish_folder(
        inventory.folder,
        [inventory.folder / name for name in inventory.shard_names() if is_there[name]],
        **{key: origin[key] for key in ("command", "config", "versions", "licence")},
    )
    return tuple(name for name in damaged if is_there[name]), tuple(lost)
