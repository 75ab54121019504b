"""Making damaged data sets whole: by playing lost episodes again, or by keeping all that is whole."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from openvima.data.checksums import spans_of
from openvima.data.manifest import CACHE_FOLDER, FAILED_FOLDER, finish_folder
from openvima.data.planning import COMMAND, GenerateConfig
from openvima.data.shard import Shard
from openvima.data.verification.checks import DEFAULT, verify
from openvima.data.verification.findings import Report, Verification, VerifyConfig
from openvima.data.verification.inventory import Inventory, take_inventory
from openvima.data.verification.regenerate import (
    finish_anew,
    fits,
    make_anew,
    settings_in_manifest,
    settings_in_shards,
)
from openvima.data.verification.salvage import Salvaged, salvage
from openvima.errors import DatasetError, OpenVimaError


@dataclass(frozen=True, slots=True)
class Repair:
    """What a repair did.

    Args:
        before: What was found first.
        after: What is found now.
        made_anew: Shards that were generated again.
        rewritten: Shards of which the whole records were kept.
        lost: Episodes that are gone: what the index tells of each.
        deleted: Files of tokens that were not those of the demonstrations; they are made anew when needed.
    """

    before: Verification
    after: Verification
    made_anew: tuple[str, ...] = ()
    rewritten: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    deleted: tuple[str, ...] = ()

    def record(self) -> dict[str, Any]:  # Any: JSON
        """Return everything as plain values."""
        did = {name: list(getattr(self, name)) for name in ("made_anew", "rewritten", "lost", "deleted")}
        return {**self.after.record(), "repaired": {"before": self.before.record(), **did}}


def repair(folder: str | Path, config: VerifyConfig = DEFAULT, report: Report | None = None) -> Repair:
    """Verify a data set, make it whole, and verify it again.

    Shards of a generated data set are generated again, and are then the same byte for byte. Of others the
    whole records are kept. Index and manifest are written anew. No whole record is ever lost, and a file is
    replaced only by a whole one.

    Args:
        folder: Folder of demonstrations.
        config: How thoroughly to verify the result, and with how many workers.
        report: Called with episodes done, episodes in all, and what is being done.

    Raises:
        DatasetError: There is no data set, or it cannot be made whole with the versions installed.
        ShardError: A damaged shard has whole records that cannot be kept.
        WorkerError: A worker died; repeat the command.
    """
    folder = Path(folder)
    if take_inventory(folder).holds_failed:
        raise DatasetError(f"{folder} belongs to {folder.parent}; repair that, and it is made whole too.")
    before = verify(folder, replace(config, replay=0), report)
    if before.is_clean:
        return Repair(before, verify(folder, config, report))
    deleted = _delete_tokens(before)
    inventory = take_inventory(folder)
    origin = inventory.manifest or inventory.doubtful
    if origin is None or origin["command"] == COMMAND:
        made_anew = _regenerate(inventory, before.damaged, config, report)
        return Repair(before, verify(folder, config, report), made_anew=made_anew, deleted=deleted)
    rewritten, lost = _salvage(inventory, origin, before.damaged)
    return Repair(before, verify(folder, config, report), (), rewritten, lost, deleted)


def _delete_tokens(found: Verification) -> tuple[str, ...]:
    names = sorted({p.file for p in found.problems if p.file.startswith(f"{CACHE_FOLDER}/")})
    for name in names:
        (found.folder / name).unlink(missing_ok=True)
    return tuple(names)


def _regenerate(
    inventory: Inventory, damaged: tuple[str, ...], config: VerifyConfig, report: Report | None
) -> tuple[str, ...]:
    """Generate what is damaged or missing, and write index and manifest."""
    folder, checksums = inventory.folder, _checksums(inventory, "")
    if inventory.manifest is not None:
        settings = settings_in_manifest(folder, inventory.manifest, config)
        versions = inventory.manifest["versions"]
    else:
        settings, versions = _settings_without_manifest(inventory, damaged, config)
    if settings.keep_failed:
        checksums |= _checksums(take_inventory(folder / FAILED_FOLDER), f"{FAILED_FOLDER}/")
    made_anew = make_anew(settings, versions, damaged, checksums=checksums, report=report)
    finish_anew(settings, versions)
    return made_anew


def _settings_without_manifest(
    inventory: Inventory, damaged: tuple[str, ...], config: VerifyConfig
) -> tuple[GenerateConfig, dict[str, str]]:
    """Find settings, and versions, that all shards agree with."""
    folder = inventory.folder
    broken = [name for name in damaged if "/" not in name]
    whole = [Shard(folder / name) for name in inventory.shard_names() if name not in broken]
    if whole:
        candidates = [settings_in_shards(folder, whole, config)]
        if inventory.doubtful is not None:  # which also knows of shards that are missing
            with contextlib.suppress(DatasetError):
                candidates.insert(0, settings_in_manifest(folder, inventory.doubtful, config))
        for settings in candidates:
            with contextlib.suppress(OpenVimaError):  # a task that is not installed, or no asset pack
                if fits(settings, whole, broken):
                    return settings, whole[0].info.versions
    raise DatasetError(
        f"the manifest of {folder} is lost, and its shards are not those of one `openvima generate` command. "
        "Repeat the command that wrote it, or restore dataset.json from a copy."
    )


def _checksums(inventory: Inventory, place: str) -> dict[str, str]:
    shards = {} if inventory.manifest is None else inventory.manifest["shards"]
    return {place + name: entry["sha256"] for name, entry in shards.items()}


def _salvage(
    inventory: Inventory,
    manifest: dict[str, Any],  # Any: JSON
    damaged: tuple[str, ...],
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Keep the whole records of damaged shards, and write index and manifest of what there is then."""
    parts, lost = inventory.index_parts(), []
    for name in damaged:
        part = parts.get(name)
        kept = salvage(inventory.folder / name, None if part is None else spans_of(part))
        lost += _lost(name, part, kept)
    finish_folder(
        inventory.folder,
        [path for name in inventory.shard_names() if (path := inventory.folder / name).is_file()],
        command=manifest["command"],
        config=manifest["config"],
        versions=manifest["versions"],
        licence=manifest["licence"],
    )
    return tuple(name for name in damaged if (inventory.folder / name).is_file()), tuple(lost)


def _lost(name: str, part: pa.Table | None, kept: Salvaged) -> Iterator[str]:
    """Name the episodes of a shard that are gone; without an index nothing tells which they were."""
    if part is None:
        yield f"what {name} held besides {kept.num_kept} whole records"
        return
    for row in part.to_pylist():
        if row["content_hash"] not in kept.content_hashes:
            yield f"{row['task']} {row['level']} seed {row['seed']} ({name}, record {row['row']})"
