"""Published success rates of the papers' models, for comparison."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources

from openvima.evaluation.results import Results
from openvima.scene.action import PRIMITIVES
from openvima.tasks.prompts import MULTIMODAL

BESIDE = "VIMA 200M"  # the only model whose success by task was published for all levels
RELIABILITY = (
    "Published numbers, not measured here. Reliability A (*): printed by the authors. B (†): quoted by "
    "public re-implementations. C (no mark): read off figures of the VIMA and MIDAS papers, to about 0.2 "
    "points, those with ~ to about 0.5. Each of these models was evaluated on 200 episodes per task; that "
    "alone gives an uncertainty of 1.6 points on the means of L1 to L3 and 3.5 on L4. D (‡): counted from "
    "public results of single episodes, 20 per task: LLaRA, LLaVA-1.5 of 7 B weights fine-tuned on 80,000 "
    "demonstrations, whose text lists boxes and names of the objects from the simulator. Simulator, assets "
    "and demonstrations differ, and some results use detected boxes: differences of a few points are not "
    "meaningful."
)
BY_TASK = (
    "Rates by task of VIMA 200M were printed by the authors and are taken from re-implementations that quote "
    "them (A by way of B); those of MIDAS are the authors’ ablations (A), those with ~ rounded to whole "
    "points (C). Those of LLaRA are counted (D). Other models have no published rates by task."
)
PUBLISHED_SETTINGS: Mapping[str, object] = {
    "prompts": MULTIMODAL,
    "task_options": "",
    "control": PRIMITIVES,
}
_MARKS = {"A": "*", "B": "†", "C": "", "D": "‡"}


@dataclass(frozen=True, slots=True)
class PublishedModel:
    """Level means of a model from a paper.

    Args:
        model: Its name in the paper.
        size: Parameters of its controller, such as "200M".
        data_fraction: Fraction of the demonstrations that it was trained on.
        levels: Success rate at each level (%).
        rough: Levels whose number is read off to half a point only, and tasks with a rounded one.
        grade: Reliability of the numbers: "A", "B", "C" or "D", see `RELIABILITY`.
        aside: Whether it is a variant or another kind of model, outside curves and leading models.
        tasks: Success rates by task (%), of the tasks for which they were published, at each level.
    """

    model: str
    size: str
    levels: Mapping[str, float]
    data_fraction: float = 1.0
    rough: tuple[str, ...] = ()
    grade: str = "C"
    aside: bool = False
    tasks: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name with size, and the fraction of the data if it is not all."""
        fraction = "" if self.data_fraction == 1 else f", {100 * self.data_fraction:g} % of the data"
        return f"{self.model} {self.size}".rstrip() + fraction

    @property
    def num_parameters(self) -> float:
        """Its size as a number."""
        return float(self.size.removesuffix("M")) * 1e6

    def mark(self, level: str) -> str:
        """Mark of a level's number, as `RELIABILITY` explains it."""
        return "~" if level in self.rough else _MARKS[self.grade]

    def written(self, level: str, rate: float) -> str:
        """Write a rate (%), with the marks that `RELIABILITY` explains if it is that of the level."""
        if rate != self.levels.get(level):
            return f"{rate:.1f}"
        mark = self.mark(level)
        return f"~{rate:.1f}" if mark == "~" else f"{rate:.1f}{mark}"

    def written_task(self, level: str, task: str) -> str:
        """Write the rate on a task; "–" where none was published."""
        rate = self.tasks.get(level, {}).get(task)
        return "–" if rate is None else f"{'~' if task in self.rough else ''}{rate:.1f}"


@cache
def published_models() -> tuple[PublishedModel, ...]:
    """All models whose success was published."""
    file = resources.files("openvima.report").joinpath("published.json")
    return tuple(
        PublishedModel(**record) for record in json.loads(file.read_text(encoding="utf-8"))["models"]
    )


def leading_models() -> list[PublishedModel]:
    """The largest of each kind, trained on all data."""
    whole = [row for row in published_models() if row.data_fraction == 1 and not row.aside]
    return list({row.model: row for row in whole}.values())  # sizes ascend


def models_by_task(results: Results) -> list[PublishedModel]:
    """Models with published rates of tasks that were evaluated."""
    played = {(row.level, row.task) for row in results.rows}
    return [
        model
        for model in published_models()
        if any(task in model.tasks.get(level, {}) for level, task in played)
    ]


def beside() -> PublishedModel:
    """The model `BESIDE`."""
    return next(model for model in published_models() if model.name == BESIDE)


def has_published_tasks(results: Results) -> bool:
    """Whether `BESIDE` was evaluated on one of the tasks of these results."""
    return beside() in models_by_task(results)


def published_rate(level: str, tasks: Sequence[str], model: PublishedModel | None = None) -> float | None:
    """Mean rate (%) of a model, by default `BESIDE`, over tasks of a level; None if it was not published.

    Over all tasks it is the published mean of the level.
    """
    model = model or beside()
    if beside().tasks.get(level, {}).keys() == set(tasks):
        return model.levels.get(level)
    rates = model.tasks.get(level, {})
    return sum(rates[task] for task in tasks) / len(tasks) if rates.keys() >= set(tasks) else None


def is_comparable(results: Results) -> bool:
    """Whether prompts, task options and control are as published; success with others is another quantity."""
    return not unusual_settings(results)


def unusual_settings(results: Results, usual: Mapping[str, object] = PUBLISHED_SETTINGS) -> str:
    """Name settings in sentences that are not the usual ones, by default those that were published."""
    return "".join(
        f" {name.replace('_', ' ').capitalize()}: {found}."
        for name, value in usual.items()
        if (found := results.config.get(name, value)) != value
    )


def published_rows(results: Results, models: Sequence[PublishedModel]) -> list[tuple[str, tuple[str, ...]]]:
    """Name of each model, and its mean at each level over the tasks that were evaluated there.

    Args:
        results: The evaluation to compare with.
        models: Models; those without any number are left out.
    """
    rows = []
    for model in models:
        rates = ((level, published_rate(level, results.tasks(level), model)) for level in results.levels())
        means = tuple("–" if rate is None else model.written(level, rate) for level, rate in rates)
        if set(means) != {"–"}:
            rows.append((model.name, means))
    return rows
