"""`rearrange_then_restore`: move objects to their places in a goal image, then back.

Scene:    as in `rearrange`: one to three objects; a single one has a distractor, often on its target.
Prompt:   "Rearrange objects to this setup {scene} and then restore."
Success:  each object was within 0.1 m of its target and, in a later step than the last of these, of its
          start; at the end the distractor is as near to no object, target or start.
Source:   VIMA paper, task list of the appendix, "Rearrange then restore".
"""

from openvima.scene import AtPose, DistractorsApart, Problem, Prompt
from openvima.tasks.registry import register_task
from openvima.tasks.scene_prompts import CONFLICT_RATE, TOLERANCE, sample_arrangement
from openvima.tasks.table import TableSampler

TEMPLATE = "Rearrange objects to this setup {scene} and then restore."


@register_task(
    "rearrange_then_restore",
    family=("visual_goal_reaching", "visual_reasoning"),  # VIMA-Bench keeps it among tasks that need memory
    template=TEMPLATE,
    oracle_max_steps=8,
)
def sample(
    table: TableSampler,
    *,
    num_objects: int | None = None,
    num_distractors: int | None = None,
    conflict_rate: float = CONFLICT_RATE,
    distractor_textures: str = "all",
    restore_distractor: bool = False,
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
        restore_distractor: Ask for the distractor at its original place as well, after the objects were at
            their targets; it then must stay in the workspace. In the benchmark a distractor that was in the
            way must not come back.
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
    arrange, starts = arrangement.goals, arrangement.starts
    to_restore = [starts[index] for index in table.rng.permutation(len(starts))]
    apart = DistractorsApart(arrangement.distractor_ids, at_end=True)
    if restore_distractor and arrangement.distractor is not None:
        to_restore.append(arrangement.distractor)
        apart = DistractorsApart(arrangement.distractor_ids, at_end=True, goals=tuple(range(len(arrange))))
    restore = tuple(AtPose(start.id, start.pose, TOLERANCE) for start in to_restore)
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(TEMPLATE, scene=arrangement.goal_image),
        goals=(*arrange, *restore),
        constraints=(apart,),
        stages=(len(arrange), len(restore)),
        prerequisites=arrangement.prerequisites,
    )
