"""`novel_noun`: put one object into another; images define their invented names.

Scene:    a base, an object to move, and distractors of other shapes, which may be bases.
Prompt:   "This is a wug {base_obj}. This is a zup {dragged_obj_1}. Put a zup into a wug." The first two
          sentences come in either order; their images are gray, so that names refer to shapes.
Success:  object within 0.1 m of the base's origin, while no distractor is as near to either of them.
Source:   VIMA paper, task list of the appendix, "Novel noun".
"""

from openvima.scene import Problem, Prompt
from openvima.tasks.novel_words import NOUNS, gray_image
from openvima.tasks.options import Difficulty, NumDistractors, textures_by_difficulty
from openvima.tasks.placing import into_base, of_a_third_shape, place_base_and_target, place_distractors
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

INTRODUCTIONS = ("This is a {novel_name_1} {dragged_obj_1}.", "This is a {novel_name_2} {base_obj}.")
REQUEST = "Put a {novel_name_1} into a {novel_name_2}."


@register_task(
    "novel_noun",
    family="novel_concept_grounding",
    template=" ".join((*INTRODUCTIONS, REQUEST)),
    oracle_max_steps=3,
    distractors_allowed=True,
)
def sample(
    table: TableSampler,
    *,
    num_distractors: NumDistractors = 1,
    difficulty: Difficulty = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Further objects, 0 … 6.
        difficulty: "easy", or "medium" and "hard", which mix and swap the textures of the two roles.
    """
    noun, base_noun = table.shuffled(NOUNS)[:2]
    dragged_textures, base_textures = textures_by_difficulty(table, difficulty)
    base, target = place_base_and_target(
        table, dragged_textures=dragged_textures, base_textures=base_textures
    )
    draw_distractor = of_a_third_shape(table, base, target, (*dragged_textures, *base_textures))
    distractors = place_distractors(table, draw_distractor, count=num_distractors)
    prompt = Prompt.parse(
        " ".join((*table.shuffled(INTRODUCTIONS), REQUEST)),
        novel_name_1=noun,
        novel_name_2=base_noun,
        dragged_obj_1=gray_image(target),
        base_obj=gray_image(base),
    )
    return into_base(table, prompt, target=target, base=base, distractors=distractors)
