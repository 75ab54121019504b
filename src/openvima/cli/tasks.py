"""`openvima tasks`: list the tasks."""

from openvima.cli.terminal import Task, print_table
from openvima.tasks.options import option_descriptions
from openvima.tasks.registry import oracle_record


def main(
    name: Task = None,
    *,
    level: str | None = None,
) -> None:
    """List the tasks: prompt, tool, levels, steps and success rate of the oracle; or describe one.

    Example: openvima tasks rotate

    Args:
        name: Task to describe, with its options for --task-options.
        level: List the tasks of this level only: train, L1 to L8.
    """
    from rich.table import Table
    from rich.text import Text

    from openvima.tasks import task_spec
    from openvima.tasks.registry import tasks_of

    if name is not None:
        spec = task_spec(name)
        descriptions, families = option_descriptions(spec), ", ".join(spec.families).replace("_", " ")
        print(f"{name}: {spec.summary}\nPrompt: {spec.template}")
        print(f"Levels: {', '.join(spec.levels)}. At most {spec.max_steps} steps. Family: {families}.")
        if descriptions:
            table = Table("option", "default", "description", title=f"options of {name}")
            for option, default in spec.options.items():
                table.add_row(option, _shown(default), descriptions[option])
            print_table(table)
        if "difficulty" in descriptions:
            print(f"Example: openvima demo {name} --task-options difficulty=hard")
        return
    specs = [task_spec(name) for name in tasks_of(level)]
    columns = ("task", "family", "prompt", "tool", "levels", "steps", "oracle")
    table = Table(*columns, title=f"{len(specs)} tasks", show_lines=True)
    for spec in specs:
        record = oracle_record(spec.name).values()
        episodes, solved = (sum(level[name] for level in record) for name in ("episodes", "successes"))
        table.add_row(
            spec.name,
            ", ".join(spec.families).replace("_", " "),
            Text(spec.template),  # rich would read its braces and brackets as markup
            spec.end_effector,
            " ".join(spec.levels),
            f"{spec.oracle_max_steps} + 2",
            f"{100 * solved / episodes:.2f}" if episodes else "-",
        )
    print_table(table)
    print("steps: the oracle's limit, and what a policy may add to it")
    print("oracle: success rate in %, over all levels")
    print("`openvima tasks TASK` lists the options of a task")


def _shown(default: object) -> str:
    """Write a default as --task-options takes it."""
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, tuple | list):
        return "+".join(map(str, default))
    return "" if default is None else str(default)
