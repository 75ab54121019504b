"""`novel_adj_and_noun`: put an object into a base; adjective and both nouns are invented.

Scene:    a base, two objects that differ in height or shade only, and two distractors of other shapes.
Prompt:   "This is a wug {dragged_obj}. This is a dax {base_obj}. {demo_blicker_obj_1} is kobar than
          {demo_less_blicker_obj_1}. …  Put the less kobar wug into the dax." The first two sentences come in
          either order, their images are gray; three comparisons, "less" or not.
Success:  the right object within 0.1 m of the base's origin, while nothing else is near either of them.
Source:   VIMA paper, task list of the appendix, "Novel adjective and noun".
"""

from openvima.scene import Problem
from openvima.tasks.novel_words import COMPARISONS, NOUNS, adjective_problem, sample_adjective_example
from openvima.tasks.options import Difficulty, NumDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

INTRODUCTIONS = ("This is a {novel_name_1} {dragged_obj}.", "This is a {novel_name_2} {base_obj}.")
REQUEST = "Put the {adv}{novel_adj} {novel_name_1} into the {novel_name_2}."


@register_task(
    "novel_adj_and_noun",
    family="novel_concept_grounding",
    template=" ".join((*INTRODUCTIONS, COMPARISONS, REQUEST)),
    oracle_max_steps=3,
)
def sample(
    table: TableSampler,
    *,
    num_distractors: NumDistractors = 2,
    difficulty: Difficulty = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Further objects of other shapes, 0 … 6.
        difficulty: "easy"; "medium" and "hard" add an object of another shape with the attribute of the
            twin or of the target.
    """
    example = sample_adjective_example(table)
    noun, base_noun = table.shuffled(NOUNS)[:2]
    introductions = table.shuffled(INTRODUCTIONS)
    return adjective_problem(
        table,
        example,
        " ".join((*introductions, COMPARISONS, REQUEST)),
        num_distractors=num_distractors,
        difficulty=difficulty,
        novel_name_1=noun,
        novel_name_2=base_noun,
    )
