"""`novel_adj`: put the object to which an adjective applies into the base; comparisons define the adjective.

Scene:    a base, and two objects that differ in height or shade only.
Prompt:   "{demo_blicker_obj_1} is kobar than {demo_less_blicker_obj_1}. …  Put the less kobar {dragged_obj}
          into the {base_obj}." Three comparisons, "less" or not; the last two images are gray.
Success:  the right object within 0.1 m of the base's origin, while its twin is near neither.
Source:   VIMA paper, task list of the appendix, "Novel adjective".
"""

from openvima.scene import Problem
from openvima.tasks.novel_words import COMPARISONS, adjective_problem, sample_adjective_example
from openvima.tasks.options import Difficulty, NumDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

REQUEST = "Put the {adv}{novel_adj} {dragged_obj} into the {base_obj}."


@register_task(
    "novel_adj",
    family="novel_concept_grounding",
    template=f"{COMPARISONS} {REQUEST}",
    oracle_max_steps=3,
    distractors_allowed=True,
)
def sample(
    table: TableSampler,
    *,
    num_distractors: NumDistractors = 0,
    difficulty: Difficulty = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Further objects of other shapes, 0 … 6.
        difficulty: "easy"; "medium" and "hard" add an object of another shape with the attribute of the
            twin or of the target.
    """
    return adjective_problem(
        table,
        sample_adjective_example(table),
        f"{COMPARISONS} {REQUEST}",
        num_distractors=num_distractors,
        difficulty=difficulty,
    )
