"""Ship a run as the bundled weights: checkpoint, settings, metrics, log and list of training data."""

import json
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml

from openvima.atomic_io import atomic_write_file
from openvima.data import Dataset
from openvima.errors import ConfigError, DatasetError
from openvima.policies.build import count_parameters, outline_network
from openvima.policies.checkpoint import load_network, read_info, write_checkpoint
from openvima.policies.naming import CONFIG_FILE, METRICS_FILE, WEIGHTS_FILE
from openvima.policies.t5 import tokenizer_for
from openvima.training.config import flatten
from openvima.training.run_folder import SESSIONS_FILE, TIMINGS_FILE, read_costs, read_lines
from training_data import appearance_record, appearance_text

RECORD = "training"  # folder beside the weights
DATA = "training_data.json"
_FILES = (CONFIG_FILE, METRICS_FILE, SESSIONS_FILE, TIMINGS_FILE)
_SETTING = re.compile(r"(_prob|warmup_steps|\.steps|_scenes|_px|_weight|batch_size|learning_rate)$")
_COMMITS = 12  # letters


@dataclass(frozen=True, slots=True)
class Shipped:
    """What the files beside the weights say.

    Args:
        parameters: Parameters of the network.
        num_bytes: Size of the weights file.
        data_hash: Content hash of the demonstrations.
        episodes: Number of demonstrations.
        commits: Commits at which the run was started and resumed.
        steps: Steps of each stage.
        hours: Wall-clock hours, of all sessions.
    """

    parameters: int
    num_bytes: int
    data_hash: str
    episodes: int
    commits: tuple[str, ...]
    steps: tuple[int, ...]
    hours: float


def ship(run: Path, folder: Path, data: Path | None = None) -> None:
    """Copy the best checkpoint of a run, in float16, and its record into the folder of the bundled weights.

    Args:
        run: A finished run folder.
        folder: Where the bundled checkpoint lies, with its card, which stays.
        data: The demonstrations, to list what they show; None if the list in the folder is of them already.

    Raises:
        DatasetError: A file of the run is missing.
        ConfigError: The run was trained on other data, or on changed sources.
    """
    missing = [name for name in _FILES if not (run / name).is_file()]
    if missing:
        raise DatasetError(f"{run} lacks {', '.join(missing)}; give the folder of a finished training.")
    sessions = _sessions(run)
    changed = [each["git"]["commit"] for each in sessions if each.get("git", {}).get("changed", True)]
    if changed:
        raise ConfigError(f"{run} ran with uncommitted changes at {changed[0]}; train from a clean clone.")
    listed = folder / DATA
    text = (
        listed.read_text(encoding="utf-8")
        if data is None
        else appearance_text(appearance_record(Dataset(data)))
    )
    known, used = json.loads(text)["manifest"]["content_hash"], sessions[-1]["data"]["content_hash"]
    if known != used:
        raise ConfigError(f"{run} was trained on data {used}; {data or listed} are {known}. Give its --data.")
    network, tokenizer = load_network(run)
    # File by file, since the folder holds more than the checkpoint.
    write_checkpoint(network, folder, tokenizer_for(network.config.prompt, tokenizer), dtype=torch.float16)
    atomic_write_file(listed, text)
    (folder / RECORD).mkdir(exist_ok=True)
    for name in _FILES:
        shutil.copyfile(run / name, folder / RECORD / name)


def shipped(folder: Path) -> Shipped | None:
    """Read the record of the bundled weights; None where it is absent."""
    if not (folder / RECORD / SESSIONS_FILE).is_file():
        return None
    sessions, costs = _sessions(folder / RECORD), read_costs(folder / RECORD)
    return Shipped(
        count_parameters(outline_network(read_info(folder).config))["total"].total,
        (folder / WEIGHTS_FILE).stat().st_size,
        sessions[-1]["data"]["content_hash"],
        sessions[-1]["data"]["counts"]["episodes"],
        tuple(dict.fromkeys(each["git"]["commit"][:_COMMITS] for each in sessions)),
        tuple(steps for _, steps in sorted(costs["steps"].items())),
        costs["seconds"] / 3600,
    )


def facts(found: Shipped) -> list[tuple[str, str]]:
    """Return the record as pairs of words."""
    stages = ("contrastive pretraining", "behaviour cloning")[
        -len(found.steps) :
    ]  # --init-from skips the first
    return [
        ("parameters", f"{found.parameters:,}"),
        ("weights file", f"{found.num_bytes / 1e6:.1f} MB, float16"),
        ("demonstrations", f"{found.episodes:,}, content hash {found.data_hash}"),
        *((stage, f"{steps:,} steps") for stage, steps in zip(stages, found.steps, strict=True)),
        ("time", f"{found.hours:.1f} h of wall-clock time"),
        ("commit", ", ".join(found.commits)),
    ]


def settings(folder: Path) -> list[tuple[str, str]]:
    """Return the settings of the shipped run that add or change data, where they are not zero."""
    chosen = flatten(
        yaml.safe_load((folder / RECORD / "config.yaml").read_text(encoding="utf-8"))["training"]
    )
    return [(name, f"{value:g}") for name, value in chosen.items() if _SETTING.search(name) and value]


def _sessions(run: Path) -> list[dict[str, Any]]:
    return read_lines(run / SESSIONS_FILE)
