"""`novel_adj`: learn an adjective from comparisons, then put the thing into the base to which it applies.

Scene:    a base and two twins that differ in height or in shade only.
Prompt:   "{demo_blicker_obj_1} is kobar than {demo_less_blicker_obj_1}. …  Put the less kobar {dragged_obj}
          into the {base_obj}." Three comparisons, "less" or not; the last two pictures are gray.
Success:  the right twin within 0.1 m of the base's origin, while the other one is near neither of them.
Source:   VIMA paper, task list of the appendix, "Novel adjective".
"""

from collections.abc import Sequence

from openvima.scene import Problem, Prompt
from openvima.tasks.comparisons import (
    MEANINGS,
    NUM_COMPARISONS,
    comparison_text,
    place_base_and_twins,
    sample_lesson,
)
from openvima.tasks.into_base import into_base
from openvima.tasks.novel_words import ADJECTIVES, gray_image
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

REQUEST = "Put the {adv}{novel_adj} {dragged_obj} into the {base_obj}."


@register_task(
    "novel_adj",
    family="novel_concept_grounding",
    template=f"{comparison_text()} {REQUEST}",
    oracle_max_steps=3,
)
def sample(
    table: TableSampler,
    *,
    adjectives: str | Sequence[str] = ADJECTIVES,
    meanings: str | Sequence[str] = MEANINGS,
    num_comparisons: int = NUM_COMPARISONS,
    num_distractors: int = 0,
    difficulty: str = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: The table to lay.
        adjectives: Invented adjectives to choose from.
        meanings: What they may mean: "shorter", "taller", "lighter", "darker", "smaller", "larger".
        num_comparisons: Pairs of objects that show the meaning, 1 … 9.
        num_distractors: Further objects of other shapes, 0 … 3.
        difficulty: "easy"; "medium" and "hard" add an object of another shape that is, in what the adjective
            is about, like the wrong twin or like the right one.
    """
    lesson = sample_lesson(table, adjectives=adjectives, meanings=meanings, num_comparisons=num_comparisons)
    base, target, others = place_base_and_twins(
        table, lesson, num_distractors=num_distractors, difficulty=difficulty
    )
    prompt = Prompt.parse(
        f"{lesson.text} {REQUEST}",
        **lesson.fills,
        dragged_obj=gray_image(target),
        base_obj=gray_image(base),
    )
    return into_base(table, prompt, target=target, base=base, distractors=others)
