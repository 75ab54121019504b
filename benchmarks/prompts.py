"""How often text prompts are ambiguous, and whether a reader of the others finds the goal objects.

    python benchmarks/prompts.py [--tasks a,b] [--prompts text|text,paraphrased] [--episodes N] [--json FILE]
    python benchmarks/prompts.py --results FILE [--multimodal FILE] [--json FILE]

The reader gets the text and the records of the scene: of each object name, texture and pose. It knows the
catalogue and the sentences of the 17 tasks, no image, no role and no goal. `--results` counts the episodes of
an evaluation with text prompts by whether they are ambiguous, beside the same ones with published prompts.
"""

import argparse
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from openvima.catalog import OBJECTS, TEXTURES
from openvima.evaluation import Results
from openvima.scene import AtPose, Episode, InZone, Placement, Scene
from openvima.tasks import list_tasks, sample_episode, task_spec
from openvima.tasks.sampling import takes_prompts

DIRECTIONS = {"north": (-1, 0), "south": (1, 0), "west": (0, -1), "east": (0, 1)}  # signs of x and y
SAME_LINE_M = 0.05  # across the direction
NEAR_M = 0.05  # an object in a container, from its origin


def _any_of(words: Iterable[str]) -> str:
    return "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))


NAMES = {name for spec in OBJECTS.values() for name in (spec.name, *spec.aliases)}
TEXTURE = rf"(?P<texture>{_any_of(TEXTURES)}) "
COMPARISON = re.compile(
    rf"[Tt]he ({_any_of(TEXTURES)}) [\w -]+? is ([\w-]+) than the ({_any_of(TEXTURES)}) [\w -]+?\."
)
INTRODUCTION = re.compile(rf"[Tt]his is a ([\w-]+): an? ({_any_of(NAMES)})\.")


@dataclass(frozen=True, slots=True)
class Reading:
    """What a text asks for.

    Args:
        moved: Ids of the objects to move.
        others: Ids of the objects that it names besides.
    """

    moved: frozenset[int]
    others: frozenset[int]


def read(text: str, scene: Scene) -> Reading:
    """Find the objects of a text prompt."""
    is_darker = {word: _is_dark(one) and not _is_dark(other) for one, word, other in COMPARISON.findall(text)}
    words = dict(INTRODUCTION.findall(text))
    request = INTRODUCTION.sub("", COMPARISON.sub("", text))
    adjectives = f"(?:(?P<less>less )?(?P<adjective>{_any_of(is_darker)}) )?" if is_darker else ""
    mention = re.compile(rf"\b{adjectives}(?:{TEXTURE})?(?P<name>{_any_of(NAMES | words.keys())})(?:s|es)?\b")
    groups = []
    for found in mention.finditer(request):
        named = found.groupdict()
        name = words.get(named["name"], named["name"])
        fitting = [p for p in scene.placements if name in (p.object, *OBJECTS[p.object].aliases)]
        fitting = [p for p in fitting if named["texture"] in (None, p.texture)]
        if adjective := named.get("adjective"):
            dark = is_darker[adjective] != bool(named["less"])
            fitting = [p for p in fitting if _is_dark(p.texture) == dark]
        groups.append(fitting)
    return _roles(request, groups, scene)


def _roles(request: str, groups: list[list[Placement]], scene: Scene) -> Reading:
    first, rest = groups[0], [p for group in groups[1:] for p in group]
    if "all objects with the same" in request:
        (base,) = first
        alike = _same_texture if "same texture" in request else _same_profile
        return _reading([p for p in scene.placements if p.id != base.id and alike(p, base)], first)
    if direction := re.search(r"at its (\w+)", request):
        (dragged,) = first
        return _reading([dragged, _neighbour(dragged, direction[1], scene)], rest)
    if "original container" in request:
        (dragged,) = first
        near = [p for p in scene.placements if p.id != dragged.id and _distance(p, dragged) < NEAR_M]
        return _reading(first, [*rest, *near])
    return _reading(first, rest)


def _reading(moved: Iterable[Placement], others: Iterable[Placement]) -> Reading:
    return Reading(frozenset(p.id for p in moved), frozenset(p.id for p in others))


def _is_dark(texture: str) -> bool:
    return texture.startswith("dark ")


def _same_texture(one: Placement, other: Placement) -> bool:
    return one.texture == other.texture


def _same_profile(one: Placement, other: Placement) -> bool:
    return OBJECTS[one.object].profile == OBJECTS[other.object].profile


def _distance(one: Placement, other: Placement) -> float:
    return ((one.pose.x - other.pose.x) ** 2 + (one.pose.y - other.pose.y) ** 2) ** 0.5


def _neighbour(placement: Placement, direction: str, scene: Scene) -> Placement:
    """Return the nearest object in a direction."""
    along_x, along_y = DIRECTIONS[direction]

    def ahead(other: Placement) -> float:
        return along_x * (other.pose.x - placement.pose.x) + along_y * (other.pose.y - placement.pose.y)

    def beside(other: Placement) -> float:
        return abs(along_y * (other.pose.x - placement.pose.x) + along_x * (other.pose.y - placement.pose.y))

    there = [p for p in scene.placements if ahead(p) > SAME_LINE_M and beside(p) < SAME_LINE_M]
    return min(there, key=ahead)


def is_understood(episode: Episode) -> bool:
    """Whether the reader finds exactly the objects that the goals move, and where they are to go."""
    problem = episode.problem
    try:
        reading = read(problem.prompt.text, problem.scene)
    except (ValueError, IndexError):
        return False
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose | InZone)]
    moved = {goal.object_id for goal in goals}
    relative = {goal.relative_to for goal in goals} - {None, *moved}
    return reading.moved == moved and relative <= reading.others


def measure(task: str, level: str, *, prompts: str, episodes: int) -> dict[str, int]:
    """Count ambiguous episodes, and those of the others whose goal objects the reader finds."""
    sampled = [sample_episode(task, level=level, seed=seed, prompts=prompts) for seed in range(episodes)]
    clear = [episode for episode in sampled if not episode.problem.prompt.is_ambiguous]
    return {"episodes": episodes, "clear": len(clear), "understood": sum(map(is_understood, clear))}


def score_by_ambiguity(results: Results, published: Results | None) -> list[dict[str, object]]:
    """Count, for each row of an evaluation, ambiguous episodes and solved ones."""
    prompts = str(results.config["prompts"])
    rows: list[dict[str, object]] = []
    for row in results.rows:
        ambiguous = {
            outcome.seed
            for outcome in row.outcomes
            if sample_episode(
                row.task, level=row.level, seed=outcome.seed, domain="eval", prompts=prompts
            ).problem.prompt.is_ambiguous
        }
        solved = {outcome.seed for outcome in row.outcomes if outcome.success}
        there = published and published.row(row.policy, row.task, row.level)
        rows.append(
            {
                "policy": row.policy,
                "task": row.task,
                "level": row.level,
                "episodes": row.episodes,
                "solved": row.successes,
                "interval": [round(end, 4) for end in row.interval],
                "ambiguous": len(ambiguous),
                "ambiguous_solved": len(ambiguous & solved),
                **({"multimodal_solved": there.successes} if there else {}),
            }
        )
    return rows


def _print_scores(rows: list[dict[str, object]]) -> None:
    print("| task | level | multimodal | text | ambiguous | solved of these | of the others |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    for row in rows:
        episodes, solved, ambiguous, guessed = (
            int(str(row[name])) for name in ("episodes", "solved", "ambiguous", "ambiguous_solved")
        )
        of_these = f"{guessed} | {solved - guessed}/{episodes - ambiguous}" if ambiguous else "– | –"
        published = row.get("multimodal_solved", "–")
        print(f"| {row['task']} | {row['level']} | {published} | {solved} | {ambiguous} | {of_these} |")


def main() -> None:
    """Measure, print a table, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--tasks", default="all", help="names with commas between, or all")
    parser.add_argument("--prompts", default="text", help="text, or text,paraphrased")
    parser.add_argument("--episodes", type=int, default=1000, help="of each task and level")
    parser.add_argument("--json", type=Path, help="file to write")
    parser.add_argument("--results", type=Path, help="results.json of an evaluation with text prompts")
    parser.add_argument("--multimodal", type=Path, help="results.json of the same episodes as published")
    options = parser.parse_args()
    if options.results is not None:
        published = Results.read(options.multimodal) if options.multimodal else None
        rows = score_by_ambiguity(Results.read(options.results), published)
        _print_scores(rows)
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        return
    tasks = list_tasks() if options.tasks == "all" else options.tasks.split(",")
    counts = {
        task: {
            level: measure(task, level, prompts=options.prompts, episodes=options.episodes)
            for level in task_spec(task).levels
        }
        for task in tasks
        if takes_prompts(task, options.prompts)
    }
    print("| task | level | ambiguous | goal objects found in the others |\n| --- | --- | ---: | ---: |")
    for task, levels in counts.items():
        for level, count in levels.items():
            ambiguous = 1 - count["clear"] / count["episodes"]
            print(f"| {task} | {level} | {ambiguous:.1%} | {count['understood']}/{count['clear']} |")
    if options.json:
        record = {"prompts": options.prompts, "tasks": counts}
        options.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
