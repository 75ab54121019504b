"""`visual_manipulation`: put the pictured object into the pictured base.

Scene:    a base, an object to move, and distractors. A distractor may share the shape or the texture of the
          object or of the base, but not both; it may itself look like a base.
Prompt:   "Put the {dragged_obj_1} into the {base_obj}."
Success:  object within 0.1 m of the base's origin, while no distractor is as near to either of them.
Source:   VIMA paper, task list of the appendix, "Simple object manipulation".
"""

from openvima.scene import AtPose, DistractorsApart, ObjectImage, Problem, Prompt, Tolerance
from openvima.tasks.options import check_count, textures_by_difficulty
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

TEMPLATE = "Put the {dragged_obj_1} into the {base_obj}."
TOLERANCE = Tolerance(position_m=0.1)


@register_task("visual_manipulation", family="simple_manipulation", template=TEMPLATE, oracle_max_steps=3)
def sample(table: TableSampler, *, num_distractors: int = 1, difficulty: str = "easy") -> Problem:
    """Sample one problem.

    Args:
        table: The table to lay.
        num_distractors: Further objects, 0 … 3.
        difficulty: "easy", or "medium" and "hard", which mix and exchange the textures of the two roles.
    """
    check_count("num_distractors", num_distractors, high=3)
    dragged_textures, base_textures = textures_by_difficulty(table, difficulty)
    dragged_objects, base_objects = table.pool.dragged_objects, table.pool.base_objects
    apart_m = TOLERANCE.position_m  # nearer, and the episode would be decided at the start

    base_texture = table.choose(base_textures)
    target_texture = table.choose(dragged_textures)
    base = table.place_one("base", lambda: (table.choose(base_objects), base_texture))
    target = table.place_one(
        "target", lambda: (table.choose(dragged_objects), target_texture), apart_m=apart_m
    )

    taken = {(base.object, base.texture), (target.object, target.texture)}

    def draw_distractor() -> tuple[str, str]:
        while True:
            look = (
                table.choose((*dragged_objects, *base_objects)),
                table.choose((*dragged_textures, *base_textures)),
            )
            if look not in taken:
                return look

    distractors = table.place(
        "distractor",
        draw_distractor,
        count=num_distractors,
        tries=num_distractors + 10,
        apart_m=apart_m,
    )
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(TEMPLATE, dragged_obj_1=ObjectImage(target), base_obj=ObjectImage(base)),
        goals=(AtPose(target.id, base.pose, TOLERANCE, relative_to=base.id),),
        constraints=(DistractorsApart(tuple(d.id for d in distractors)),),
    )
