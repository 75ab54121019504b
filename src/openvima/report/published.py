"""Success rates of the papers' models, as published elsewhere: for orientation beside one's own."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources

# The only model whose success by task was published for all levels.
BESIDE = ("VIMA", "200M")
RELIABILITY = (
    "Published elsewhere, not measured here. Level means are read off figures of the VIMA and MIDAS papers, "
    "to about 0.2 points; those with ~ to about 0.5. Those with * were printed by the authors. Rates by task "
    "of VIMA 200M were printed too, and are taken from public re-implementations that quote them. Each model "
    "was scored on 200 episodes a task, which alone leaves about 1.6 points either way on the means of L1 to "
    "L3 and 3.5 on L4. Another simulator, other assets and demonstrations, and detected instead of true "
    "boxes in some cases: differences of a few points to them mean nothing."
)


@dataclass(frozen=True, slots=True)
class PublishedModel:
    """Level means of a model from a paper.

    Args:
        model: Its name there.
        size: Parameters of its controller, such as "200M".
        data_share: Share of the demonstrations that it was trained on.
        levels: Success rate at each level (%).
        printed: Whether the authors printed the numbers; else they are read off figures.
        rough: Levels whose number is read off to half a point only.
    """

    model: str
    size: str
    levels: Mapping[str, float]
    data_share: float = 1.0
    printed: bool = False
    rough: tuple[str, ...] = field(default=())

    @property
    def name(self) -> str:
        """Name with size, and with the share of data where it is not all."""
        share = "" if self.data_share == 1 else f", {100 * self.data_share:g} % of the data"
        return f"{self.model} {self.size}{share}"

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
    largest = {row.model: row for row in published_models() if row.data_share == 1}  # sizes ascend
    return list(largest.values())


def published_tasks(level: str) -> Mapping[str, float]:
    """Success rates by task (%) of VIMA 200M at a level, for all tasks of that level."""
    for record in _content()["tasks"]:
        if (record["model"], record["size"], record["level"]) == (*BESIDE, level):
            return record["tasks"]
    return {}


@cache
def _content() -> dict[str, list[dict]]:
    file = resources.files("openvima.report").joinpath("published.json")
    return json.loads(file.read_text(encoding="utf-8"))
