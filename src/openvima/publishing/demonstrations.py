"""Demonstrations on the Hugging Face Hub, with a dataset card."""

import json
import shlex
from pathlib import Path

from openvima import __version__
from openvima.data.manifest import INDEX_NAME, MANIFEST_NAME, fingerprint
from openvima.data.reader import Dataset
from openvima.errors import ShardError
from openvima.hub import HubName, commit
from openvima.publishing.card import CARD_NAME, TAGS, checked_licence, facts, fenced, front_matter, repository
from openvima.report.typesetting import Line, Table, markdown

_SIZES = {1_000: "n<1K", 10_000: "1K<n<10K", 100_000: "10K<n<100K", 1_000_000: "100K<n<1M"}


def push_demonstrations(
    folder: str | Path, name: str, *, private: bool = False, message: str = ""
) -> HubName:
    """Push a finished data set to the Hugging Face Hub in one commit, with a dataset card.

    Shards, index and manifest are pushed; failed episodes and object caches are not.

    Args:
        folder: Folder of demonstrations.
        name: The repository, as OWNER/NAME or OWNER/NAME@BRANCH; it is created if there is none.
        private: Whether a new repository is private.
        message: Of the commit.

    Returns:
        The repository at the new commit; `Dataset` takes it with "hf://" in front.

    Raises:
        DatasetError: The folder is no finished data set.
        ShardError: A shard is not the one that the manifest describes.
        HubError: The Hub refuses or cannot be reached.
        MissingExtraError: `huggingface_hub` is not installed.
    """
    target, files = repository(name), demonstrations_files(folder, name)
    note = message or f"Push with openvima {__version__}"
    return commit(target, files, kind="dataset", message=note, private=private)


def demonstrations_files(folder: str | Path, name: str) -> dict[str, Path | bytes]:
    """Return what `push_demonstrations` pushes: path in the repository to a local file or content."""
    dataset = Dataset(folder)
    for shard, entry in dataset.manifest["shards"].items():
        if fingerprint(dataset.path / shard)["sha256"] != entry["sha256"]:
            raise ShardError(
                f"{dataset.path / shard} is damaged: its checksum is not that of the manifest. "
                f"`openvima data verify {shlex.quote(str(dataset.path))}` says more."
            )
    files: dict[str, Path | bytes] = {CARD_NAME: demonstrations_card(dataset, name).encode()}
    names = (MANIFEST_NAME, INDEX_NAME, *dataset.manifest["shards"])
    return files | {file: dataset.path / file for file in names}


def demonstrations_card(dataset: Dataset, name: str) -> str:
    """Write the card of a data set: contents by task, provenance, licence.

    Args:
        dataset: The data set.
        name: The repository, as for `push_demonstrations`.

    Returns:
        Markdown with the metadata of the Hub in front.

    Raises:
        ConfigError: The licence of the data set is no identifier.
    """
    manifest, target = dataset.manifest, repository(name)
    counts = manifest["counts"]
    metadata = {
        "license": [checked_licence(licence) for licence in manifest["licence"].split(" AND ")],
        "task_categories": ["robotics"],
        "tags": TAGS,
        "size_categories": [next((s for n, s in _SIZES.items() if counts["episodes"] < n), "1M<n<10M")],
    }
    provenance = {
        "episodes": f"{counts['episodes']:,}",
        "steps": f"{counts['steps']:,}",
        "content hash": manifest["content_hash"],
        "written by": manifest["command"],
        **{package: f"version {version}" for package, version in sorted(manifest["versions"].items())},
    }
    lines = tuple(
        Line(task, (f"{row['episodes']:,}", f"{row['steps']:,}", f"{100 * row['success_rate']:.1f}"))
        for task, row in manifest["tasks"].items()
    )
    columns = ("task", "episodes", "steps", "oracle success (%)")
    contents = Table("tasks", "Demonstrations by task.", columns, lines)
    parts = [
        front_matter(metadata),
        f"# {target.repo.partition('/')[2]}\n",
        "Demonstrations of VIMA-Bench: tabletop manipulation from multimodal prompts of words and images.\n",
        f"## Contents\n\n{markdown([contents])}",
        f"## Provenance\n\n{facts('What the manifest records.', provenance)}",
        "Settings that decide the content:\n",
        fenced(json.dumps(manifest["config"], indent=1, sort_keys=True, ensure_ascii=False), "json"),
        f"## Use\n\n{_use(target)}",
        f"## Licence\n\n{manifest['licence']}\n",
    ]
    return "\n".join(parts)


def _use(name: HubName) -> str:
    shell = (
        f"pip install 'openvima[train,hub]'\nopenvima data info hf://{name}\n"
        f"openvima train --data hf://{name} --preset nano --out run"
    )
    python = f'from openvima.data import Dataset\n\nepisode = Dataset("hf://{name}")[0]'
    return f"{fenced(shell, 'sh')}\n{fenced(python, 'python')}"
