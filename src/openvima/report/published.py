"""Published success rates of the papers' models, for comparison."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources

from openvima.evaluation.results import Results
from openvima.tasks.prompts import MULTIMODAL

# The only model whose success by task was published for all levels.
BESIDE = ("VIMA", "200M")
RELIABILITY = (
    "Published numbers, not measured here. Level means are read off figures of the VIMA and MIDAS papers, to "
    "about 0.2 points; those with ~ to about 0.5. Those with * were printed by the authors. Rates by task of "
    "VIMA 200M were printed, too, and are taken from public re-implementations that quote them. Each model "
    "was evaluated on 200 episodes per task; that alone gives an uncertainty of 1.6 points on the means of "
    "L1 to L3 and 3.5 on L4. Simulator, assets and demonstrations differ, and some results use detected "
    "boxes: differences of a few points are not meaningful."
)


@dataclass(frozen=True, slots=True)
class PublishedModel:
    """Level means of a model from a paper.

    Args:
        model: Its name in the paper.
        size: Parameters of its controller, such as "200M".
        data_fraction: Fraction of the demonstrations that it was trained on.
        levels: Success rate at each level (%).
        printed: Whether the authors printed the numbers; else they are read off figures.
        rough: Levels whose number is read off to half a point only.
    """

    model: str
    size: str
    levels: Mapping[str, float]
    data_fraction: float = 1.0
    printed: bool = False
    rough: tuple[str, ...] = field(default=())

    @property
    def name(self) -> str:
        """Name with size, and the fraction of the data if it is not all."""
        fraction = "" if self.data_fraction == 1 else f", {100 * self.data_fraction:g} % of the data"
        return f"{self.model} {self.size}{fraction}"

    @property
    def num_parameters(self) -> float:
        """Its size as a number."""
        return float(self.size.removesuffix("M")) * 1e6

    def mark(self, level: str) -> str:
        """Mark of a level's number, as `RELIABILITY` explains it."""
        return "*" if self.printed else "~" if level in self.rough else ""

    def written(self, level: str, rate: float, keep_marks: bool = True) -> str:
        """Write a rate (%), with the marks that `RELIABILITY` explains if it is that of the level."""
        if rate != self.levels.get(level):
            return f"{rate:.1f}"
        mark = "~" if level in self.rough else ""
        return f"{mark}{rate:.1f}{'*' if self.printed and keep_marks else ''}"


@cache
def published_models() -> tuple[PublishedModel, ...]:
    """All models whose level means were published."""
    return tuple(PublishedModel(**record) for record in _content()["levels"])


def leading_models() -> list[PublishedModel]:
    """The largest of each kind, trained on all data."""
    largest = {row.model: row for row in published_models() if row.data_fraction == 1}  # sizes ascend
    return list(largest.values())


def published_tasks(level: str) -> Mapping[str, float]:
    """Success rates by task (%) of VIMA 200M at a level, for all tasks of that level."""
    for record in _content()["tasks"]:
        if (record["model"], record["size"], record["level"]) == (*BESIDE, level):
            return record["tasks"]
    return {}


def published_rate(level: str, tasks: Sequence[str], model: PublishedModel | None = None) -> float | None:
    """Mean rate (%) of a model, by default VIMA 200M, over tasks of a level; None if it was not published.

    Over all tasks it is the published mean of the level.
    """
    model = model or next(m for m in published_models() if (m.model, m.size, m.data_fraction) == (*BESIDE, 1))
    rates = published_tasks(level)
    if rates and rates.keys() == set(tasks):
        return model.levels.get(level)
    by_task = (model.model, model.size, model.data_fraction) == (*BESIDE, 1)
    known = by_task and tasks and rates.keys() >= set(tasks)
    return sum(rates[task] for task in tasks) / len(tasks) if known else None


def is_comparable(results: Results) -> bool:
    """Whether prompts and task options are as published; success with others is another quantity."""
    return not unpublished_settings(results)


def unpublished_settings(results: Results) -> str:
    """Name the form of prompts and the task options in a sentence, unless they are as published."""
    prompts, options = results.config.get("prompts", MULTIMODAL), results.config.get("task_options", "")
    return (f" Prompts: {prompts}." if prompts != MULTIMODAL else "") + (
        f" Task options: {options}." if options else ""
    )


def published_rows(
    results: Results, models: Sequence[PublishedModel], *, keep_marks: bool = True
) -> list[tuple[str, tuple[str, ...]]]:
    """Name of each model, and its mean at each level over the tasks that were evaluated there.

    Args:
        results: The evaluation to compare with.
        models: Models; those without any number are left out.
        keep_marks: Whether to mark numbers that the authors printed.
    """
    rows = []
    for model in models:
        rates = ((level, published_rate(level, results.tasks(level), model)) for level in results.levels())
        means = tuple(
            "–" if rate is None else model.written(level, rate, keep_marks) for level, rate in rates
        )
        if set(means) != {"–"}:
            rows.append((model.name, means))
    return rows


def published_coverage(results: Results) -> str:
    """Say on how many of a level's tasks the means rest, where it is not all."""
    tasks = {level: results.tasks(level) for level in results.levels() if published_tasks(level)}
    partial = [
        f"{len(set(own) & published_tasks(level).keys())} of {len(published_tasks(level))} at {level}"
        for level, own in tasks.items()
        if published_tasks(level).keys() != set(own)
    ]
    if not partial:
        return "Published means are over the same tasks."
    return (
        f"Published means are over the same tasks: {', '.join(partial)}. There, only the rates of "
        f"{' '.join(BESIDE)} were published by task."
    )


@cache
def _content() -> dict[str, list[dict]]:
    file = resources.files("openvima.report").joinpath("published.json")
    return json.loads(file.read_text(encoding="utf-8"))
