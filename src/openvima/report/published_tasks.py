"""All published success rates by task, beside the measured ones."""

from openvima.evaluation.results import Results
from openvima.report.published import BY_TASK, models_by_task, published_tasks, task_rate
from openvima.report.typesetting import Estimate, Line, Table


def published_task_table(results: Results) -> Table | None:
    """Rates by task of policies and published models, at the evaluated levels; None without any."""
    models, policies = models_by_task(), results.policy_names()
    lines = []
    for level in results.levels():
        of_level = published_tasks(level)
        for index, task in enumerate(of_level if of_level.keys() & set(results.tasks(level)) else ()):
            rows = [results.row(policy, task, level) for policy in policies]
            own = [Estimate(row.rate, row.interval) if row else "–" for row in rows]
            elsewhere = [task_rate(model, level, task) for model in models]
            lines.append(Line(task, (level, *own, *elsewhere), starts_group=index == 0 and bool(lines)))
    if not lines:
        return None
    columns = ("task", "level", *policies, *(f"{model} {size} (published)" for model, size in models))
    caption = f"Success rates (%) by task, measured ones with 95 % intervals. {BY_TASK}"
    return Table("published-tasks", caption, columns, tuple(lines))
