"""`visual_manipulation`: put one object into another; images specify both.

Scene:    a base, an object to move, and distractors. A distractor may share the shape or the texture of the
          object or of the base, but not both; it may be a base.
Prompt:   "Put the {dragged_obj_1} into the {base_obj}."
Success:  object within 0.1 m of the base's origin, while no distractor is as near to either of them.
Source:   VIMA paper, task list of the appendix, "Simple object manipulation".
"""

from openvima.scene import ObjectImage, Problem, Prompt
from openvima.tasks.options import Difficulty, NumDistractors, textures_by_difficulty
from openvima.tasks.placing import into_base, place_base_and_target, place_distractors
from openvima.tasks.registry import register_task
from openvima.tasks.table import Appearance, TableSampler

TEMPLATE = "Put the {dragged_obj_1} into the {base_obj}."


@register_task(
    "visual_manipulation",
    family="simple_object_manipulation",
    template=TEMPLATE,
    oracle_max_steps=3,
    distractors_allowed=True,
)
def sample(
    table: TableSampler, *, num_distractors: NumDistractors = 1, difficulty: Difficulty = "easy"
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Further objects, 0 … 6.
        difficulty: "easy", or "medium" and "hard", which mix and swap the textures of the two roles.
    """
    dragged_textures, base_textures = textures_by_difficulty(table, difficulty)
    base, target = place_base_and_target(
        table, dragged_textures=dragged_textures, base_textures=base_textures
    )
    objects = (*table.pool.dragged_objects, *table.pool.base_objects)
    textures = (*dragged_textures, *base_textures)
    taken = {(base.object, base.texture), (target.object, target.texture)}

    def draw_distractor() -> Appearance:
        while True:
            appearance = (table.choose(objects), table.choose(textures))
            if appearance not in taken:
                return appearance

    distractors = place_distractors(table, draw_distractor, count=num_distractors)
    prompt = Prompt.parse(TEMPLATE, dragged_obj_1=ObjectImage(target), base_obj=ObjectImage(base))
    return into_base(table, prompt, target=target, base=base, distractors=distractors)
