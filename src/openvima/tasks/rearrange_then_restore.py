"""`rearrange_then_restore`: move objects to their places in a goal image, then back.

Scene:    as in `rearrange`: one to three objects; a single one has a distractor, often on its target.
Prompt:   "Rearrange objects to this setup {scene} and then restore."
Success:  each object was within 0.1 m of its target and, in a later step than the last of these, of its
          start; at the end the distractor is as near to no object, target or start.
Source:   VIMA paper, task list of the appendix, "Rearrange then restore".
"""

from dataclasses import replace
from typing import Literal

from openvima.scene import AtPose, DistractorsApart, Problem, Prompt
from openvima.tasks import rearrange
from openvima.tasks.options import Difficulty, SomeDistractors
from openvima.tasks.registry import register_task
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
    num_distractors: SomeDistractors = None,
    distractor_textures: Literal["all", "pool"] = "all",
    restore_distractor: bool = False,
    difficulty: Difficulty = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Distractors, 0 … 6; by default one for a single object, else none.
        distractor_textures: "all" 49 light textures, as in the benchmark at every level, or "pool": only
            those of the level.
        restore_distractor: Ask for the distractor at its original place as well, after the objects were at
            their targets; it then must stay in the workspace. In the benchmark a distractor that was in the
            way must not come back.
        difficulty: "easy", "medium" or "hard"; without effect, as in the benchmark.
    """
    problem = rearrange.sample(
        table,
        num_distractors=num_distractors,
        distractor_textures=distractor_textures,
        difficulty=difficulty,
    )
    arrange, (apart,) = problem.goals, problem.constraints
    assert isinstance(apart, DistractorsApart)
    starts = [problem.scene[goal.object_id] for goal in arrange if isinstance(goal, AtPose)]
    to_restore = table.shuffled(starts)
    if restore_distractor and len(starts) == 1 and apart.object_ids:
        to_restore.append(problem.scene[apart.object_ids[0]])
        apart = replace(apart, goals=tuple(range(len(arrange))))
    restore = tuple(AtPose(start.id, start.pose, rearrange.TOLERANCE) for start in to_restore)
    return replace(
        problem,
        prompt=Prompt(TEMPLATE, problem.prompt.images),
        goals=(*arrange, *restore),
        constraints=(apart,),
        stages=(len(arrange), len(restore)),
    )
