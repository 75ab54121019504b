"""`openvima evaluate`: score policies on levels L1 to L4."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from openvima.cli.progress import progress_bar

if TYPE_CHECKING:
    from openvima.evaluation import Results


def main(
    *,
    policy: str,
    tasks: str = "all",
    levels: str = "L1,L2,L3,L4",
    episodes: int = 50,
    seed: int = 0,
    workers: int = 1,
    out: Path = Path("evaluation"),
    assets: str = "procedural",
    compat: bool = False,
    difficulty: str = "easy",
    batch: int = 16,
    videos: int = 1,
    report: bool = True,
    force: bool = False,
    device: str = "cpu",
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Score policies on tasks and levels, and write results.json and report.html.

    The numbers depend on neither the number of workers nor the machine's load. An interrupted evaluation
    goes on where it stopped.

    Example: openvima evaluate --policy mine=runs/first,oracle,random --levels L1,L2 --workers 2

    Args:
        policy: One or more of oracle, random, untrained, presets, folders of training runs, published files
            and ids on the Hugging Face Hub, with commas in between; NAME=FOLDER gives a folder another name.
        tasks: Names of tasks with commas in between, or all. A level that does not hold a task leaves it out.
        levels: Levels with commas in between: train, L1, L2, L3, L4.
        episodes: Episodes for each policy, task and level.
        seed: Number of the first episode; evaluation episodes never occur in training.
        workers: Processes.
        out: Folder to write to.
        assets: procedural, original (see `openvima assets import`), or a checkout of the original benchmark.
        compat: Follow the original benchmark also where it is odd; docs/compat.md lists the differences.
        difficulty: easy, as for all published results, medium or hard.
        batch: Episodes that are played together; a policy decides for all of them at once.
        videos: Solved episodes to film, and unsolved ones, of each trained policy and task.
        report: Whether to film episodes and write report.html.
        force: Overwrite the results of another evaluation in that folder.
        device: Where networks compute: cpu, in float64, or cuda, in float32.
        as_json: Print the rows as JSON instead of a table.

    Returns:
        Exit status.
    """
    from openvima.env import Setup
    from openvima.evaluation import EvaluationConfig, Results, evaluate

    config = EvaluationConfig(
        policies=_words(policy),
        tasks=_words(tasks),
        levels=_words(levels),
        episodes=episodes,
        seed=seed,
        workers=workers,
        out=out,
        setup=Setup(assets, compat, difficulty),
        batch=batch,
        videos=videos,
        report=report,
        force=force,
        device=device,
    )
    with progress_bar("evaluation") as bar:
        path = evaluate(config, bar)
    if as_json:
        print(json.dumps(json.loads(path.read_text(encoding="utf-8"))["rows"]))
    else:
        print_results(Results.read(path))
    print(
        f"Results: {path}" + (f"   Report: {path.with_name('report.html')}" if report else ""),
        file=sys.stderr,
    )
    return 0


def print_results(results: "Results") -> None:
    """Print success rates as a table, a row a task and level, a column a policy."""
    from rich.console import Console
    from rich.table import Table

    policies = results.policy_names()
    means = {(mean.policy, mean.level): mean for mean in results.level_means()}
    table = Table("level", title="solved episodes in per cent (95 % interval)")
    table.add_column("task", overflow="fold", min_width=12)
    for policy in policies:
        table.add_column(policy, justify="right", no_wrap=True)
    for level in results.levels():
        for task in results.tasks(level):
            rows = (results.row(policy, task, level) for policy in policies)
            table.add_row(level, task, *(_cell(row.rate, row.interval) if row else "–" for row in rows))
        level_means = (means.get((policy, level)) for policy in policies)
        cells = (_cell(mean.mean, mean.interval) if mean else "–" for mean in level_means)
        table.add_row(level, "mean", *cells, style="bold", end_section=True)
    Console().print(table)


def _cell(rate: float, interval: tuple[float, float]) -> str:
    return f"{100 * rate:.1f} ({100 * interval[0]:.0f}–{100 * interval[1]:.0f})"


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())
