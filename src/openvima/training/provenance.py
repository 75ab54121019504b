"""Versions, git commit and data of a run."""

import hashlib
import subprocess
from collections import Counter
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import openvima
from openvima.data.manifest import INDEX_NAME, MANIFEST_NAME
from openvima.data.reader import Dataset

_PACKAGES = ("torch", "numpy", "pyarrow", "safetensors", "transformers")


def provenance(dataset: Dataset) -> dict[str, Any]:  # Any: JSON
    """Return versions, the git commit of the package if it is in a checkout, and digests of the data."""
    content = (dataset.path / MANIFEST_NAME).read_bytes()
    return {
        "versions": {"openvima": openvima.__version__, **_versions()},
        "git": git_state(Path(openvima.__file__).parent),
        "data": {
            "content_hash": dataset.manifest["content_hash"],
            "manifest_sha256": hashlib.sha256(content).hexdigest(),
            "counts": dataset.manifest["counts"],
            "tasks": dict(sorted(Counter(dataset.index.column("task").to_pylist()).items())),
        },
    }


def held_out_demonstrations(dataset: Dataset) -> list[str]:
    """Return the task and level of demonstrations of evaluation levels or seeds, such as "twist L3".

    Each episode says its own level and domain, so merging or sampling folders hides nothing.
    """
    found = dataset.index.select(["task", "level", "domain"]).group_by(["task", "level", "domain"])
    return sorted(
        f"{row['task']} {row['level']}" + (" eval" if row["domain"] == "eval" else "")
        for row in found.aggregate([]).to_pylist()
        if row["level"] != "train" or row["domain"] == "eval"
    )


def index_hash(folder: Path) -> str:
    """Return a hash of the index of a folder of demonstrations."""
    return hashlib.blake2b((folder / INDEX_NAME).read_bytes(), digest_size=16).hexdigest()


def git_state(folder: Path) -> dict[str, Any] | None:  # Any: JSON
    """Return the commit of the checkout that contains a folder, and whether it has changes.

    Returns:
        `commit` and `changed`; None without checkout or git.
    """

    def ask(*words: str) -> str | None:
        try:
            result = subprocess.run(
                ["git", "-C", str(folder), *words],
                capture_output=True,
                encoding="utf-8",
                check=True,
                timeout=10,
            )
        except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
            return None
        return result.stdout.strip()

    commit = ask("rev-parse", "HEAD")
    if commit is None or ask("ls-files", "--error-unmatch", ".") is None:  # installed inside a checkout
        return None
    return {"commit": commit, "changed": bool(ask("status", "--porcelain", "--untracked-files=no"))}


def _versions() -> dict[str, str]:
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
