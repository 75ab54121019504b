"""`rearrange`: move objects to their places in a goal image, and clear a blocked target first.

Scene:    one to three objects away from their targets. A single object has a distractor, which is on the
          target in half of the episodes.
Prompt:   "Rearrange to this {scene}."
Success:  each object was within 0.1 m of its target, and at the end the distractor is as near to neither
          object nor target.
Source:   VIMA paper, task list of the appendix, "Rearrange".
"""

from openvima.scene import DistractorsApart, Problem, Prompt
from openvima.tasks.registry import register_task
from openvima.tasks.scene_prompts import CONFLICT_RATE, sample_arrangement
from openvima.tasks.table import TableSampler

TEMPLATE = "Rearrange to this {scene}."


@register_task("rearrange", family="visual_goal_reaching", template=TEMPLATE, oracle_max_steps=5)
def sample(
    table: TableSampler,
    *,
    num_objects: int | None = None,
    num_distractors: int | None = None,
    conflict_rate: float = CONFLICT_RATE,
    distractor_textures: str = "all",
    difficulty: str = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_objects: Objects to move, 1 … 3; by default 1, 2 or 3 with probabilities 0.4, 0.4 and 0.2.
        num_distractors: Distractors, 0 … 6; by default one for a single object, else none.
        conflict_rate: Probability that the distractor is on the target of a single object.
        distractor_textures: "all" 49 light textures, as in the benchmark at every level, or "pool": only
            those of the level.
        difficulty: "easy", "medium" or "hard"; without effect, as in the benchmark.
    """
    arrangement = sample_arrangement(
        table,
        num_objects=num_objects,
        num_distractors=num_distractors,
        conflict_rate=conflict_rate,
        distractor_textures=distractor_textures,
        difficulty=difficulty,
    )
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(TEMPLATE, scene=arrangement.goal_image),
        goals=arrangement.goals,
        constraints=(DistractorsApart(arrangement.distractor_ids, at_end=True),),
        prerequisites=arrangement.prerequisites,
    )
