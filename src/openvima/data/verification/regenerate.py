"""Making lost shards of a generated data set again, byte for byte."""

import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from openvima.data.generation import finish
from openvima.data.manifest import FAILED_FOLDER, fingerprint
from openvima.data.oracle_rollouts import write_block
from openvima.data.planning import Block, GenerateConfig, plan
from openvima.data.progress import NUM_COUNTS
from openvima.data.records import package_versions
from openvima.data.resuming import is_done
from openvima.data.shard import Shard
from openvima.data.verification.findings import Report, VerifyConfig
from openvima.env.config import EnvConfig
from openvima.errors import DatasetError, OpenVimaError
from openvima.multiprocess import Counts, in_watched_processes

_STAGING = ".repair.tmp"


def settings_in_manifest(
    folder: Path,
    manifest: Mapping[str, Any],  # Any: JSON
    config: VerifyConfig,
) -> GenerateConfig:
    """Return how a folder was generated, as its manifest says.

    Raises:
        DatasetError: The settings are none of today's.
    """
    changes = {"keep_failed": _has_failed(folder), "workers": config.workers}
    try:
        found = GenerateConfig.from_record(folder, manifest["config"], **changes)
    except (OpenVimaError, TypeError) as error:
        raise DatasetError(f"{folder} cannot be generated again: {error}") from None
    assets = config.assets if config.assets and found.setup.assets != "procedural" else found.setup.assets
    return replace(found, setup=replace(found.setup, assets=assets))


def settings_in_shards(folder: Path, whole: Sequence[Shard], config: VerifyConfig) -> GenerateConfig:
    """Find out from its shards how a folder was generated.

    Args:
        folder: A folder without a manifest.
        whole: Those of its shards that can be read, one at least.
        config: Number of workers, and where the assets are.
    """
    info, episodes = whole[0].info, Counter[str]()
    for shard in whole:
        episodes[shard.info.task] += len(shard)
    return GenerateConfig(
        out=folder,
        tasks=tuple(sorted(episodes)),
        episodes=max(episodes.values()),
        level=info.level,
        start_seed=info.first_seed,
        shard_size=info.shard_size or None,
        setup=EnvConfig(config.assets or info.assets, info.compat, info.difficulty),
        compression="zstd" if info.compression == "zstd" else "lz4",
        images=info.images,
        keep_failed=_has_failed(folder),
        workers=config.workers,
    )


def fits(settings: GenerateConfig, whole: Sequence[Shard], damaged: Sequence[str]) -> bool:
    """Say whether all shards of a folder are among those that some settings give.

    Args:
        settings: The settings.
        whole: Those of its shards that can be read.
        damaged: Names of the others.
    """
    blocks = {block.path.name: block for block in plan(settings)}
    return blocks.keys() >= {*damaged, *(shard.path.name for shard in whole)} and all(
        shard.info == replace(blocks[shard.path.name].info, versions=shard.info.versions)
        and len(shard) == blocks[shard.path.name].episodes
        for shard in whole
    )


def make_anew(
    settings: GenerateConfig,
    versions: Mapping[str, str],
    damaged: Sequence[str],
    *,
    checksums: Mapping[str, str],
    report: Report | None = None,
) -> tuple[str, ...]:
    """Generate shards again; each takes its place once all of them are whole and known to be the same.

    Args:
        settings: How the folder was generated.
        versions: By which versions.
        damaged: Names of shards, relative to the folder.
        checksums: Name to SHA-256 of shards as they were, where it is known.
        report: Called with episodes done, episodes in all, and what is being done.

    Returns:
        Names of the shards that were written: those that are damaged or missing, and what belongs to them.

    Raises:
        DatasetError: They cannot be made the same again. Nothing was changed.
    """
    blocks = [block for block in plan(settings) if _is_wanted(block, damaged)]
    names = {name for block in blocks for name in _names(block)}
    if strangers := sorted(set(damaged) - names):
        raise DatasetError(f"by its settings, {settings.out} has no {strangers[0]}; nothing was changed.")
    if not blocks:
        return ()
    _check_versions(settings.out, versions, num_shards=len(blocks))
    staging = settings.out / _STAGING
    shutil.rmtree(staging, ignore_errors=True)  # of a repair that was killed
    staging.mkdir()
    try:
        _write([_staged(block, staging) for block in blocks], settings.workers or 1, report)
        written = [name for name in sorted(names) if (staging / name).is_file()]
        for name in written:
            _check_bytes(staging / name, settings.out / name, checksums.get(name))
        for name in written:
            (settings.out / name).parent.mkdir(exist_ok=True)
            os.replace(staging / name, settings.out / name)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return tuple(written)


def finish_anew(settings: GenerateConfig, versions: Mapping[str, str]) -> None:
    """Write indexes and manifests of a generated folder whose shards are all there."""
    blocks = [replace(b, info=replace(b.info, versions=dict(versions))) for b in plan(settings)]
    finish(settings, blocks)


def _check_bytes(written: Path, place: Path, sha256: str | None) -> None:
    """Refuse a shard that is not what it was.

    One that is as the manifest says and yet damaged was damaged before it was listed: then nothing tells.

    Raises:
        DatasetError: Its bytes are others than the manifest says.
    """
    if sha256 is None or fingerprint(written)["sha256"] == sha256:
        return
    if not place.is_file() or fingerprint(place)["sha256"] != sha256:
        raise DatasetError(
            f"{place} was generated again, but not with the bytes that the manifest tells. "
            "Nothing was changed."
        )


def _has_failed(folder: Path) -> bool:
    return any((folder / FAILED_FOLDER).glob("*"))


def _names(block: Block) -> tuple[str, str]:
    return block.path.name, f"{FAILED_FOLDER}/{block.path.name}"


def _is_wanted(block: Block, damaged: Sequence[str]) -> bool:
    """Whether a block must be written: one of its shards is damaged, or lacks its failed episodes."""
    return any(name in damaged for name in _names(block)) or not is_done(block)


def _check_versions(folder: Path, versions: Mapping[str, str], *, num_shards: int) -> None:
    installed = package_versions()
    others = [
        f"{name} {versions.get(name, 'of an unknown version')} (installed: {version})"
        for name, version in installed.items()
        if versions.get(name) != version
    ]
    if others:
        raise DatasetError(
            f"{num_shards} shards of {folder} must be generated again, which gives the same bytes only with "
            f"{', '.join(others)}. Install these versions and repeat the command; nothing was changed."
        )


def _staged(block: Block, staging: Path) -> Block:
    failed = None if block.failed_path is None else staging / FAILED_FOLDER / block.path.name
    return replace(block, path=staging / block.path.name, failed_path=failed)


def _write(blocks: Sequence[Block], num_workers: int, report: Report | None) -> None:
    total = sum(block.episodes for block in blocks)

    def watch(counts: Counts) -> None:
        if report is not None:
            report(sum(row[0] for row in counts), total, "generating again")

    for _ in in_watched_processes(write_block, blocks, num_workers, num_counts=NUM_COUNTS, watch=watch):
        pass  # a block's result is its file
