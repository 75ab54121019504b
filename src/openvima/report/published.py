"""Published success rates of the papers' models, for comparison."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources

from openvima.evaluation.results import Results

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

    def written(self, level: str) -> str:
        """The rate at a level with its mark, as explained in `RELIABILITY`; a dash where there is none."""
        if level not in self.levels:
            return "–"
        mark = "~" if level in self.rough else ""
        return f"{mark}{self.levels[level]:.1f}{'*' if self.printed else ''}"


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


def published_rate(level: str, tasks: Sequence[str]) -> float | None:
    """Mean rate (%) of VIMA 200M over tasks of a level; None unless it was published for all of them."""
    rates = published_tasks(level)
    return sum(rates[task] for task in tasks) / len(tasks) if rates.keys() >= set(tasks) else None


def published_coverage(results: Results) -> str:
    """Say on how many of a level's tasks our means rest, where it is not all."""
    partial = [
        f"{len(set(results.tasks(level)) & published_tasks(level).keys())} of {len(published_tasks(level))} "
        f"tasks at {level}"
        for level in results.levels()
        if published_tasks(level).keys() - set(results.tasks(level))
    ]
    if not partial:
        return "Published means rest on the same tasks."
    return f"Published means rest on all tasks, those of this evaluation on {', '.join(partial)}."


@cache
def _content() -> dict[str, list[dict]]:
    file = resources.files("openvima.report").joinpath("published.json")
    return json.loads(file.read_text(encoding="utf-8"))
