"""Pages of the tasks: what each asks, its levels, tolerances and options, pictures and scores."""

import inspect
import json
import re
from collections.abc import Callable, Iterable, Mapping
from html import escape
from pathlib import Path

import openvima
from openvima.catalog import Pool
from openvima.evaluation.recording import save_episode_image
from openvima.evaluation.statistics import wilson_interval
from openvima.report.published import published_models
from openvima.tasks import TaskSpec, list_tasks, task_spec
from openvima.tasks.registry import oracle_record

ROOT = Path(__file__).parents[2]
LEVELS = {
    "train": "objects and textures of the demonstrations",
    "L1": "new placements of them",
    "L2": "new combinations of them",
    "L3": "new objects and textures",
    "L4": "a task that is not trained",
    "L5": "the objects of L3 among clutter",
    "L6": "several instructions in one prompt",
    "L7": "words for relations, superlatives, exceptions, numbers and alternatives",
    "L8": "six to twelve steps",
}
Score = tuple[int, int, tuple[float, float]]  # solved, episodes, 95 % interval


def write_task_pages(folder: Path) -> None:
    """Write a page for each task of the package, its pictures, and a list of all."""
    (folder / "images").mkdir(parents=True)
    scores = recorded_scores()
    specs = [task_spec(name) for name in list_tasks()]
    for spec in specs:
        for level in spec.levels:
            env = openvima.make(spec.name, level=level, domain="user").unwrapped
            path = folder / "images" / f"{spec.name}_{level}.png"
            save_episode_image(env, path, seed=0, enlarge=1)
        (folder / f"{spec.name}.md").write_text(task_page(spec, scores), encoding="utf-8")
    (folder / "index.md").write_text(index_page(specs), encoding="utf-8")


def index_page(specs: Iterable[TaskSpec]) -> str:
    """Show the tasks as a gallery."""
    cards = [
        f"- [![Prompt, start and end](images/{spec.name}_{spec.levels[-1]}.png)]({spec.name}.md)\n"
        f"  **[{spec.name}]({spec.name}.md)** {', '.join(spec.levels)}: {spec.summary}"
        for spec in specs
    ]
    about = "Prompt, start and end of an episode that the oracle solves, at the last level of each task."
    return "\n".join(
        ["# Tasks", "", about, "", '<div class="gallery" markdown>', "", *cards, "", "</div>", ""]
    )


def task_page(spec: TaskSpec, scores: Mapping[str, Mapping[tuple[str, str], Score]]) -> str:
    """Return the page of a task.

    Args:
        spec: The task.
        scores: For each policy and (task, level) its score.
    """
    lines = [f"# {spec.name}", "", f"{spec.summary[0].upper()}{spec.summary[1:]}", ""]
    about = sections(inspect.getmodule(spec.sample).__doc__ or "")
    lines += [f"- **{name}:** {escape(text, quote=False)}" for name, text in about.items()]
    families = ", ".join(family.replace("_", " ") for family in spec.families)
    lines += [
        f"- **Family:** {families}",
        f"- **End effector:** {spec.end_effector}",
        f"- **Step limit:** {spec.max_steps}; {spec.oracle_max_steps} for the oracle",
        "",
        "```python",
        "import openvima",
        "",
        f'env = openvima.make("{spec.name}", level="{spec.levels[-1]}")',
        "observation, info = env.reset(seed=0)",
        "```",
        "",
        "## Levels",
        "",
        "Prompt, start and end of an episode that the oracle solves.",
        "",
    ]
    for level in spec.levels:
        pool = spec.pool(level)
        lines += [f"### {level}: {LEVELS[level]}", "", pool_sentence(pool), ""]
        lines += [f"![Prompt, start and end of {spec.name} at {level}](images/{spec.name}_{level}.png)", ""]
    if spec.options:
        lines += ["## Options", "", f'Arguments of `openvima.make("{spec.name}", …)`.', ""]
        lines += ["| option | default |", "|---|---|"]
        lines += [f"| `{name}` | `{default!r}` |" for name, default in spec.options.items()]
        lines += [""]
    return "\n".join([*lines, "## Scores", "", *score_table(spec, scores), ""])


def sections(docstring: str) -> dict[str, str]:
    """Return the parts "Scene", "Prompt" and "Success" of a task file's docstring."""
    found = re.findall(r"^(\w+): +(.*(?:\n +.*)*)", docstring, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in found}


def pool_sentence(pool: Pool) -> str:
    """Say how many objects and textures a level has."""
    counts = {
        "objects to move": len(pool.dragged_objects),
        "bases": len(pool.base_objects),
        "textures": len({*pool.dragged_textures, *pool.base_textures}),
    }
    return ", ".join(f"{what}: {count}" for what, count in counts.items() if count).capitalize() + "."


def recorded_scores() -> dict[str, dict[tuple[str, str], Score]]:
    """Read the scores of policies on the tasks from the newest recorded results."""
    small = newest(lambda record: "default" in record.get("scores", {}))["scores"]["default"]
    others = newest(lambda record: "oracle" in {row.get("policy") for row in record.get("rows", ())})
    scores: dict[str, dict[tuple[str, str], Score]] = {}
    rows = [("openvima-small", row) for row in small["tasks"]]
    rows += [(row["policy"], row) for row in others["rows"] if row["policy"] != "oracle"]
    for policy, row in rows:
        if not row.get("ablation"):
            result = row["successes"], row["episodes"], tuple(row["interval"])
            scores.setdefault(policy, {})[row["task"], row["level"]] = result
    return scores


def newest(wanted: Callable[[dict], bool]) -> dict:
    """Return the newest recorded result that is as wanted."""
    for file in sorted(ROOT.glob("results/*.json"), reverse=True):
        record = json.loads(file.read_text(encoding="utf-8"))
        if wanted(record):
            return record
    raise FileNotFoundError("no recorded result in results/ has the scores that the pages of the tasks show.")


def score_table(spec: TaskSpec, scores: Mapping[str, Mapping[tuple[str, str], Score]]) -> list[str]:
    """Return the lines of the table of scores at the levels of evaluation."""
    levels = [level for level in spec.levels if level != "train"]
    oracle = oracle_record(spec.name)
    lines = [
        "Success rate in %, with 95 % interval and number of episodes. Published policies were scored in the",
        "original simulator.",
        "",
        f"| policy | {' | '.join(levels)} |",
        f"|---|{'---:|' * len(levels)}",
        f"| oracle | {' | '.join(counted(oracle[level]) if level in oracle else '–' for level in levels)} |",
    ]
    for policy, rates in scores.items():
        lines.append(f"| {policy} | {' | '.join(rated(rates.get((spec.name, level))) for level in levels)} |")
    for model in published_models():
        rates = [model.written_task(level, spec.name) for level in levels]
        if any(rate != "–" for rate in rates):
            lines.append(f"| {model.model} {model.size}, published | {' | '.join(rates)} |")
    return lines


def counted(record: Mapping[str, int]) -> str:
    """Write the score of the oracle."""
    solved, episodes = record["successes"], record["episodes"]
    return rated((solved, episodes, wilson_interval(solved, episodes)))


def rated(score: Score | None) -> str:
    """Write a score; "–" where there is none."""
    if score is None:
        return "–"
    solved, episodes, (low, high) = score
    return f"{100 * solved / episodes:.1f} ({100 * low:.1f} to {100 * high:.1f}), {episodes}"
