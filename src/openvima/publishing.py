"""Policies and demonstrations on the Hugging Face Hub, each with a card that says what it is."""

import json
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from openvima.data.manifest import INDEX_NAME, MANIFEST_NAME, fingerprint
from openvima.data.reader import Dataset
from openvima.errors import (
    ConfigError,
    DatasetError,
    InputFileError,
    ServerError,
    echo,
)
from openvima.evaluation.results import FILE_NAME, Results
from openvima.evaluation.sources import weights_hash
from openvima.evaluation.verification import is_marked_verified
from openvima.hub import HubName, commit, hub_name
from openvima.input_files import as_path
from openvima.policies.base import require_torch
from openvima.policies.loading import run_setting
from openvima.policies.naming import (
    CONFIG_FILE,
    TOKENIZER_FOLDER,
    WEIGHTS_FILE,
    find_checkpoint,
)
from openvima.report.page import default_command
from openvima.report.table import Line, Table, markdown
from openvima.report.tables import paper_tables
from openvima.report.text import role
from openvima.training.config import flatten

__all__ = ["push_demonstrations", "push_policy"]

CARD_NAME = "README.md"
TAGS = ["openvima", "vima-bench", "multimodal-prompts", "imitation-learning"]
_BUNDLED_RUN = "training"  # settings of the run beside a bundled checkpoint
_SETTINGS = (
    "preset",
    "init_from",
    "crops_from",
    "seed",
    "assets",
    "schedule.steps",
    "loader.batch_size",
    "optimizer.learning_rate",
    "pretraining.steps",
)


def push_policy(
    source: str | Path,
    name: str,
    *,
    results: str | Path | None = None,
    licence: str = "mit",
    private: bool = False,
) -> HubName:
    """Push a checkpoint to the Hugging Face Hub in one commit, with its tokenizer and a model card.

    Args:
        source: A run folder, of which the best checkpoint is pushed, a checkpoint folder, or the name of a
            bundled checkpoint.
        name: The repository, as OWNER/NAME or OWNER/NAME@BRANCH; it is created if there is none.
        results: Folder of an evaluation of these weights, for the scores on the card; its `results.json` is
            pushed too.
        licence: Identifier of the licence of the weights.
        private: Whether a new repository is private.

    Returns:
        The repository at the new commit, which `load_policy` takes as text.

    Raises:
        InputFileError: There is no such checkpoint, or it is no checkpoint folder.
        ConfigError: The results are not of these weights.
        DatasetError: There are no results, or they are damaged.
        ServerError: The Hub refuses or cannot be reached.
        MissingExtraError: torch or `huggingface_hub` is not installed.
    """
    files = policy_files(source, name, results=results, licence=licence)
    return commit(_repository(name), files, private=private)


def policy_files(
    source: str | Path, name: str, *, results: str | Path | None = None, licence: str = "mit"
) -> dict[str, Path | bytes]:
    """Return what `push_policy` pushes: path in the repository to a local file or content.

    The card says network, training, scores with intervals and licence.
    """
    require_torch("reading a checkpoint")
    folder, target = find_checkpoint(source), _repository(name)
    if not folder.is_dir():
        raise InputFileError(
            f"{source} is a file; convert it to a checkpoint folder first: `openvima policies convert`."
        )
    scored = None if results is None else as_path(results)
    metadata = {"license": licence.lower(), "library_name": "openvima", "pipeline_tag": "robotics"}
    shell = f"pip install 'openvima[train,hub]'\nopenvima evaluate --policy {target} --out scores"
    python = f'from openvima.policies import load_policy\n\npolicy = load_policy("{target}")'
    card = f"""{_heading(metadata, target)}
A policy for VIMA-Bench: tabletop manipulation from multimodal prompts of words and images.

## Network

{_network(folder)}
## Training

{_training(folder)}
## Scores

{_scores(scored, folder, target)}
## Use

{_fenced(shell, "sh")}
{_fenced(python, "python")}
## Licence

Weights: {licence.lower()}. openvima: MIT.
"""
    files: dict[str, Path | bytes] = {CARD_NAME: card.encode()}
    files |= {file: folder / file for file in (WEIGHTS_FILE, CONFIG_FILE)}
    files |= {f"{TOKENIZER_FOLDER}/{p.name}": p for p in sorted((folder / TOKENIZER_FOLDER).glob("*"))}
    if scored is not None:
        files[FILE_NAME] = scored / FILE_NAME if scored.is_dir() else scored
    return files


def _network(folder: Path) -> str:
    from openvima.policies.build import count_parameters, outline_network
    from openvima.policies.checkpoint import read_info
    from openvima.policies.tensor_files import described

    info = read_info(folder)
    count, decoder = count_parameters(outline_network(info.config))["total"], info.config.decoder
    values = {
        "architecture": info.config.architecture,
        "parameters": f"{count.total:,}, of which {count.trainable:,} were trained",
        "decoder": f"{decoder.num_layers} layers, width {decoder.width}, {decoder.num_heads} heads",
        "precision of the weights": described(info.dtype),
        f"SHA-256 of {WEIGHTS_FILE}": info.digest,
    }
    return _facts("What was pushed.", values)


def _training(folder: Path) -> str:
    """Say what the run recorded about data and settings."""
    run = folder if run_setting(folder, "training")[1] else folder / _BUNDLED_RUN
    if not (training := run_setting(run, "training")[1]):
        return "Not recorded: the checkpoint does not lie in its run folder.\n"
    settings = flatten(training)
    values = {
        "demonstrations": run_setting(run, "demonstrations", "episodes")[1],
        "tasks left out": settings.get("loader.exclude_tasks"),
        "held-out demonstrations among them": run_setting(run, "demonstrations", "held_out")[1],
        **{name: settings.get(name) for name in _SETTINGS},
    }
    return _facts("What the run folder records.", values)


def _scores(path: Path | None, folder: Path, name: HubName) -> str:
    if path is None:
        return "None were pushed with the checkpoint.\n"
    results, sha256 = Results.read(path), weights_hash(folder)
    policy = next((name for name, what in results.policies.items() if what.get("sha256") == sha256), None)
    if policy is None:
        raise ConfigError(
            f"{path} has no scores of these weights, only of {', '.join(results.policy_names())}; evaluate "
            "the checkpoint, or give the folder in which it was evaluated."
        )
    rows = tuple(row for row in results.rows if row.policy == policy)
    scores = replace(results, rows=rows, policies={policy: results.policies[policy]})
    versions = ", ".join(f"{name} {version}" for name, version in sorted(scores.versions.items()))
    tables = markdown(paper_tables(scores, published=False, confirmed=is_marked_verified(path)))
    command = _fenced(default_command(scores, [str(name)]), "sh")
    return f"{role(scores, policy)} `{FILE_NAME}` holds every outcome ({versions}).\n\n{command}\n{tables}"


def push_demonstrations(folder: str | Path, name: str, *, private: bool = False) -> HubName:
    """Push a finished data set to the Hugging Face Hub in one commit, with a dataset card.

    Shards, index and manifest are pushed; object caches are not.

    Args:
        folder: Folder of demonstrations.
        name: The repository, as OWNER/NAME or OWNER/NAME@BRANCH; it is created if there is none.
        private: Whether a new repository is private.

    Returns:
        The repository at the new commit; `Dataset` takes it with "hf://" in front.

    Raises:
        DatasetError: The folder is no finished data set.
        DatasetError: A shard is not the one that the manifest describes.
        ServerError: The Hub refuses or cannot be reached.
        MissingExtraError: `huggingface_hub` is not installed.
    """
    return commit(_repository(name), demonstrations_files(folder, name), kind="dataset", private=private)


def demonstrations_files(folder: str | Path, name: str) -> dict[str, Path | bytes]:
    """Return what `push_demonstrations` pushes: path in the repository to a local file or content.

    The card says contents by task, provenance and licence.
    """
    dataset, target = Dataset(folder), _repository(name)
    manifest = dataset.manifest
    for shard, entry in manifest["shards"].items():
        if fingerprint(dataset.path / shard)["sha256"] != entry["sha256"]:
            raise DatasetError(
                f"{dataset.path / shard} is damaged: its checksum is not that of the manifest. "
                f"`openvima data verify {shlex.quote(str(dataset.path))}` says more."
            )
    counts = manifest["counts"]
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
    metadata = {"license": manifest["licence"].lower().split(" and "), "task_categories": ["robotics"]}
    settings = json.dumps(manifest["config"], indent=1, sort_keys=True, ensure_ascii=False)
    shell = (
        f"pip install 'openvima[train,hub]'\nopenvima data info hf://{target}\n"
        f"openvima train --data hf://{target} --preset nano --out run"
    )
    python = f'from openvima.data import Dataset\n\nepisode = Dataset("hf://{target}")[0]'
    card = f"""{_heading(metadata, target)}
Demonstrations of VIMA-Bench: tabletop manipulation from multimodal prompts of words and images.

## Contents

{markdown([contents])}
## Provenance

{_facts("What the manifest records.", provenance)}
Settings that decide the content:

{_fenced(settings, "json")}
## Use

{_fenced(shell, "sh")}
{_fenced(python, "python")}
## Licence

{manifest["licence"]}
"""
    files = (MANIFEST_NAME, INDEX_NAME, *manifest["shards"])
    return {CARD_NAME: card.encode(), **{file: dataset.path / file for file in files}}


def _repository(text: str) -> HubName:
    """Read the name of the repository to push to.

    Raises:
        ServerError: It is none.
    """
    name = hub_name(text if text.startswith("hf:") else f"hf://{text}")
    if name is None:
        raise ServerError(f"{text!r} names no repository on the Hub; give OWNER/NAME or OWNER/NAME@BRANCH.")
    return name


def _heading(metadata: Mapping[str, Any], target: HubName) -> str:
    """Write the metadata of a card, and its title."""
    text = yaml.safe_dump({**metadata, "tags": TAGS}, sort_keys=False, allow_unicode=True)
    return f"---\n{text}---\n\n# {target.repo.partition('/')[2]}\n"


def _facts(caption: str, values: Mapping[str, object]) -> str:
    """Write a table of facts in Markdown, without those that are None or empty."""
    lines = tuple(
        Line(name, (echo(str(value)),)) for name, value in values.items() if value not in (None, "", [])
    )
    return markdown([Table("facts", caption, ("", ""), lines)])


def _fenced(text: str, language: str) -> str:
    """Write a block of code, which nothing in the text can end."""
    return f"```{language}\n{text.replace('`', chr(39)).rstrip()}\n```\n"
