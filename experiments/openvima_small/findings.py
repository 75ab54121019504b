"""Scores, records of the original simulator and trainings behind the tables of openvima-small."""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ablations import attribute_table, differences_table, read_rows
from openvima.errors import ConfigError, DatasetError, OpenVimaError
from openvima.evaluation.results import EpisodeOutcome, LevelMean, Results, Row
from openvima.input_files import read_json

POLICY = "openvima-small"
PUBLISHED_DEMONSTRATIONS = 650_000  # of the papers' models, the full dataset
LEVELS = ("L1", "L2", "L3", "L4")
SWAPPED = "swapped_attribute"
TEXT_ABLATIONS = ("text_prompts", "held_out_phrasings", "text_prompts+held_out_phrasings")

# Folders of SCORES: evaluations, and what their plain score is.
EVALUATIONS = {
    "default": "procedural assets",
    "original_assets": "assets of the original benchmark",
    "original_compat": "assets of the original benchmark, compat",
    "detected": "procedural assets, detected boxes",
    "second_seed": "second training seed",
    "without_ears": "trained without containers with ears",
    "previous": "previous weights",
    "previous_original_assets": "previous weights, assets of the original benchmark",
    "previous_original_compat": "previous weights, assets of the original benchmark, compat",
    "previous_detected": "previous weights, detected boxes",
    "controls": "input ablations",
    "text": "text prompts and held-out phrasings",
}
# Folders of SCORES that `examples/score_in_original_benchmark.py` wrote.
SIMULATORS = {
    "simulator": POLICY,
    "second_seed_simulator": "second training seed",
    "previous_simulator": "previous weights",
}
_OTHER_WEIGHTS = ("second_seed", "without_", "previous")
_DETECTED = "detected_boxes"
ABLATIONS, BASELINES = "ablations", "baselines"  # what the scripts of these names write
GUESS = "guess"  # GUESS.json is what `benchmarks/bounds.py --ways guess` wrote


@dataclass(frozen=True, slots=True)
class Training:
    """One evaluated training of another architecture.

    Args:
        name: Short and unique.
        what: Description, in one line.
        demonstrations: Number of training demonstrations.
        steps: Steps of behaviour cloning.
        minutes: Minutes of training.
        results: Its evaluation, with the training's name for the policy.
        parameters: Parameters of the network; 0 if unknown.
    """

    name: str
    what: str
    demonstrations: int
    steps: int
    minutes: float
    results: Results
    parameters: int = 0

    def means(self) -> dict[str, LevelMean]:
        """Success by level."""
        return level_means(self.results)


@dataclass(frozen=True, slots=True)
class Findings:
    """Data of tables and figures.

    Args:
        scores: Evaluations by the names of `EVALUATIONS` and `SIMULATORS`; absent ones are not there.
        ablations: Tables of `ablations.py`, in Markdown, by name; empty if absent.
        baselines: Other architectures at equal cost.
        guesses: Successes and episodes of a policy that reads no prompt, a pair for each task, by level.
    """

    scores: Mapping[str, Results]
    ablations: Mapping[str, str] = field(default_factory=dict)
    baselines: tuple[Training, ...] = ()
    guesses: Mapping[str, Sequence[tuple[int, int]]] = field(default_factory=dict)

    def means(self, name: str = "default") -> dict[str, LevelMean]:
        """Plain success rate by level; of `detected` and `previous_detected` that with detected boxes."""
        if name not in self.scores:
            return {}
        return level_means(self.scores[name], _DETECTED if name.endswith("detected") else "")


def level_means(results: Results, ablation: str = "") -> dict[str, LevelMean]:
    """Success by level, under one ablation."""
    return {mean.level: mean for mean in results.level_means() if mean.ablation == ablation}


def find(folder: Path, weights: str) -> Findings:
    """Read what a folder holds; a line on stderr names what is absent.

    Args:
        folder: The folder, with a folder of each name of `EVALUATIONS`, `SIMULATORS`, `ABLATIONS` and
            `BASELINES`.
        weights: SHA-256 of the bundled weights, which all evaluations but those of other weights must have.

    Raises:
        DatasetError: A file is damaged, or the folder holds nothing.
        ConfigError: An evaluation is of other weights.
    """
    found: dict[str, Results] = {}
    known = (*SIMULATORS, *EVALUATIONS, ABLATIONS, BASELINES)
    present = [name for name in known if (folder / name).is_dir()]
    if not present:
        raise DatasetError(f"{folder} holds no evaluation; it may hold the folders {', '.join(known)}.")
    for name in known:
        if name not in present:
            print(f"{folder / name} is absent; its tables are left out.", file=sys.stderr)
        elif name in SIMULATORS:
            found[name] = read_simulator(folder / name)
        elif name in EVALUATIONS:
            found[name] = _of_first_policy(Results.read(folder / name), POLICY)
            own = next(iter(found[name].policies.values())).get("sha256", "")
            if own != weights and not name.startswith(_OTHER_WEIGHTS):
                raise ConfigError(
                    f"{folder / name} is of weights {own[:12]}; those bundled are {weights[:12]}."
                )
    rows = read_rows(folder / ABLATIONS)
    made = {"ablations": differences_table(rows) if rows else "", "attributes": attribute_table(rows)}
    trainings = read_trainings(sorted((folder / BASELINES).glob("*.json")))
    guesses = read_guesses(folder / f"{GUESS}.json")
    return Findings(found, {name: table.strip() for name, table in made.items()}, trainings, guesses)


def read_guesses(file: Path) -> dict[str, list[tuple[int, int]]]:
    """Read successes and episodes of each task by level; nothing where the file is absent.

    Raises:
        DatasetError: The file is damaged.
    """
    found: dict[str, list[tuple[int, int]]] = {}
    try:
        rows = read_json(file)["rows"] if file.exists() else []
        for row in rows:
            if row["measure"] == GUESS:
                found.setdefault(row["level"], []).append((int(row["right"]), int(row["episodes"])))
    except (ValueError, TypeError, KeyError) as error:
        raise DatasetError(f"{file} cannot be read ({error!r}); measure it again.") from error
    return found


def read_simulator(folder: Path) -> Results:
    """Read the episodes of the original simulator, LEVEL/TASK/SEED.json.

    Raises:
        DatasetError: A file is damaged, or there is none.
    """
    rows = []
    for level in LEVELS:
        for task in sorted(path for path in (folder / level).glob("*") if path.is_dir()):
            outcomes = [_simulator_outcome(path) for path in task.glob("*.json")]
            if outcomes:
                ordered = tuple(sorted(outcomes, key=lambda outcome: outcome.seed))
                rows.append(Row(POLICY, task.name, level, 0, ordered))
    if not rows:
        raise DatasetError(f"{folder} has no episode LEVEL/TASK/SEED.json, as L1/rotate/40000.json.")
    return Results(tuple(rows), policies={POLICY: {}})


def _simulator_outcome(path: Path) -> EpisodeOutcome:
    try:
        content = read_json(path)
        return EpisodeOutcome(int(content["seed"]), content["success"] is True, int(content["steps"]))
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DatasetError(
            f"{path} cannot be read ({error!r}); remove it, and play its episode again."
        ) from error


def read_trainings(files: Sequence[Path]) -> tuple[Training, ...]:
    """Read trainings with their evaluations.

    Args:
        files: JSON files, each a record or a list of them. A path of an evaluation counts from the working
            directory, or from the file's folder.

    Raises:
        DatasetError: A file is missing or damaged, or an evaluation is.
        ConfigError: Two trainings have one name.
    """
    trainings: list[Training] = []
    for file in files:
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            records = content if isinstance(content, list) else [content]
            trainings += [_training(dict(record), file.parent) for record in records]
        except (OSError, ValueError, TypeError, KeyError) as error:
            if isinstance(error, OpenVimaError):
                raise
            raise DatasetError(
                f"{file} cannot be read ({error!r}); each record has name, what, demonstrations, steps, "
                "minutes and evaluation."
            ) from error
    names = [training.name for training in trainings]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f"trainings {', '.join(twice)} are given twice; each needs a name of its own.")
    return tuple(trainings)


def _training(record: dict[str, Any], folder: Path) -> Training:
    path = Path(record["evaluation"])
    if not path.exists() and (folder / path).exists():
        path = folder / path
    name = str(record["name"])
    found = Results.read(path)
    if len(found.policy_names()) > 1:
        raise ConfigError(f"{path} holds {', '.join(found.policy_names())}; one policy is wanted in each.")
    count, steps = int(record["demonstrations"]), int(record["steps"])
    minutes, parameters = float(record["minutes"]), int(record.get("parameters", 0))
    results = _of_first_policy(found, name)
    return Training(name, str(record["what"]), count, steps, minutes, results, parameters)


def _of_first_policy(results: Results, name: str) -> Results:
    """Keep the rows of the first policy, under another name."""
    first = results.policy_names()[0]
    rows = tuple(replace(row, policy=name) for row in results.rows if row.policy == first)
    return replace(results, rows=rows, policies={name: dict(results.policies.get(first, {}))})
