"""Evaluations of the bundled checkpoint and of smaller trainings."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from openvima.errors import ConfigError, DatasetError, OpenVimaError, UnknownPolicyError, unknown_name
from openvima.evaluation.comparison import Comparison, compare_pairs
from openvima.evaluation.merging import merge
from openvima.evaluation.results import LevelMean, Results

POLICY = "openvima-small"
DEMONSTRATIONS = 52_000  # of the bundled checkpoint
PUBLISHED_DEMONSTRATIONS = 650_000  # of the papers' models, the full dataset
LEVELS = ("L1", "L2", "L3", "L4")
_VIMA = "vima"  # names of trainings of its architecture begin so


@dataclass(frozen=True, slots=True)
class Training:
    """One evaluated training.

    Args:
        name: Short and unique.
        what: Description, in one line.
        demonstrations: Number of training demonstrations.
        steps: Steps of behaviour cloning.
        minutes: CPU minutes.
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

    @property
    def is_vima(self) -> bool:
        """Whether it is VIMA's architecture."""
        return self.name.startswith(_VIMA)

    def means(self) -> dict[str, LevelMean]:
        """Success by level."""
        return {mean.level: mean for mean in self.results.level_means() if not mean.ablation}


@dataclass(frozen=True, slots=True)
class Findings:
    """Data of tables and figures.

    Args:
        policy: Name of the bundled checkpoint in `results`.
        results: Its evaluation, ablations included.
        demonstrations: Number of its training demonstrations.
        trainings: Smaller trainings, compared with each other.
        baseline: The one with the full model.
        differences: Of each training with as many demonstrations and steps minus the baseline.
    """

    policy: str
    results: Results
    demonstrations: int
    trainings: tuple[Training, ...]
    baseline: Training | None
    differences: Mapping[str, Comparison]

    @property
    def variants(self) -> list[Training]:
        """Trainings that can be compared with the baseline, in the order given."""
        return [training for training in self.trainings if training.name in self.differences]

    def curve(self, *, vima: bool) -> list[Training]:
        """Trainings of one architecture, by demonstrations ascending: the full model, or VIMA's."""
        chosen = [
            training
            for training in self.trainings
            if training.is_vima == vima and (vima or training.name not in self.differences)
        ]
        return sorted(chosen, key=lambda training: (training.demonstrations, training.steps))

    def means(self) -> dict[str, LevelMean]:
        """Success rate of the bundled checkpoint by level."""
        return {
            mean.level: mean
            for mean in self.results.level_means()
            if mean.policy == self.policy and not mean.ablation
        }


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


def _training(record: dict[str, Any], folder: Path) -> Training:  # Any: JSON
    path = Path(record["evaluation"])
    if not path.exists() and (folder / path).exists():
        path = folder / path
    name = str(record["name"])
    found = Results.read(path)
    played = [row for row in found.rows if row.policy == found.policy_names()[0]]
    if len(found.policy_names()) > 1:
        raise ConfigError(f"{path} holds {', '.join(found.policy_names())}; one policy is wanted in each.")
    rows = tuple(replace(row, policy=name) for row in played)
    policies = {name: dict(next(iter(found.policies.values()), {}))}
    results = replace(found, rows=rows, policies=policies)
    count, steps = int(record["demonstrations"]), int(record["steps"])
    minutes, parameters = float(record["minutes"]), int(record.get("parameters", 0))
    return Training(name, str(record["what"]), count, steps, minutes, results, parameters)


def find(
    results: Results,
    trainings: Sequence[Training],
    *,
    policy: str = POLICY,
    baseline: str = "full",
    demonstrations: int = DEMONSTRATIONS,
) -> Findings:
    """Put together what is known.

    Raises:
        UnknownPolicyError: The evaluation has no such policy, or there is no such baseline.
        ConfigError: Two trainings that are compared played different episodes.
    """
    if policy not in results.policy_names():
        raise UnknownPolicyError(unknown_name("policy", policy, results.policy_names()))
    by_name = {training.name: training for training in trainings}
    if not by_name:
        return Findings(policy, results, demonstrations, (), None, {})
    if baseline not in by_name:
        raise UnknownPolicyError(unknown_name("training", baseline, by_name))
    full = by_name[baseline]
    compared = [
        training.name
        for training in trainings
        if training is not full
        and (training.demonstrations, training.steps) == (full.demonstrations, full.steps)
    ]
    merged = merge({name: training.results for name, training in by_name.items()}).results
    comparisons = compare_pairs(merged, [(name, baseline) for name in compared]) if compared else []
    differences = dict(zip(compared, comparisons, strict=True))
    return Findings(policy, results, demonstrations, tuple(trainings), full, differences)
