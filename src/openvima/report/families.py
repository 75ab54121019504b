"""Means by the paper's task families."""

from openvima.errors import UnknownTaskError
from openvima.evaluation.results import Results
from openvima.evaluation.statistics import mean_of_rates
from openvima.report.published import BESIDE, published_rate
from openvima.report.typesetting import Estimate, Line, Table
from openvima.tasks.registry import task_spec

FAMILIES = (  # in the paper's order
    "simple_object_manipulation",
    "visual_goal_reaching",
    "novel_concept_grounding",
    "one_shot_video_imitation",
    "visual_constraint_satisfaction",
    "visual_reasoning",
)


def family_table(results: Results, *, published: bool = True) -> Table:
    """Mean success rate of each policy over the tasks of each family, level by level.

    A task of several families counts in each of them; one that is not registered here in none.

    Args:
        results: The evaluation.
        published: Whether to add a column of the model whose rates by task were published.
    """
    policies = results.policy_names()
    lines = []
    for level in results.levels():
        for index, (family, tasks) in enumerate(_tasks(results, level).items()):
            cells = [_mean(results, policy, level, tasks) for policy in policies]
            rate = published_rate(level, tasks) if published else None
            elsewhere = ["–" if rate is None else f"{rate:.1f}"] if published else []
            name = f"{family_name(family)} ({len(tasks)})"
            lines.append(Line(name, (level, *cells, *elsewhere), starts_group=index == 0 and bool(lines)))
    caption = (
        "Success rates (%) by task family, means over the tasks of each family (their number in brackets), "
        "with 95 % intervals. A task of several families counts in each."
    )
    elsewhere = (f"{' '.join(BESIDE)} (published)",) if published else ()
    return Table("families", caption, ("family", "level", *policies, *elsewhere), tuple(lines))


def _tasks(results: Results, level: str) -> dict[str, list[str]]:
    """Evaluated tasks of each family at a level."""
    found: dict[str, list[str]] = {family: [] for family in FAMILIES}
    for task in results.tasks(level):
        for family in _families(task):
            found.setdefault(family, []).append(task)
    return {family: tasks for family, tasks in found.items() if tasks}


def _families(task: str) -> tuple[str, ...]:
    try:
        return task_spec(task).families
    except UnknownTaskError:
        return ()


def _mean(results: Results, policy: str, level: str, tasks: list[str]) -> Estimate | str:
    rows = [row for task in tasks if (row := results.row(policy, task, level))]
    if not rows:
        return "–"
    mean, interval = mean_of_rates([(row.successes, row.episodes) for row in rows])
    fewer = f"{len(rows)} of {len(tasks)} tasks" if len(rows) < len(tasks) else ""
    return Estimate(mean, interval, mark=fewer)


def family_name(family: str) -> str:
    """Name of a family as words."""
    return family.replace("_", " ").replace("one shot", "one-shot")
