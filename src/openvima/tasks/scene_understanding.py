"""`scene_understanding`: put the object of one texture, shown in a picture, into the base of another texture.

Scene:    a base, an object to move, and distractors: another shape in the object's texture, which only the
          picture tells from the object, or a base of the same shape in another texture.
Prompt:   "Put the red swirl object in {scene} into the tiles object."
Success:  object within 0.1 m of the base's origin, while no distractor is as near to either of them.
Source:   VIMA paper, task list of the appendix, "Scene understanding".
"""

from openvima.scene import AtPose, DistractorsApart, Placement, Problem, Prompt, SceneImage, Tolerance
from openvima.tasks.options import check_count, textures_by_difficulty
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

TEMPLATE = "Put the {dragged_texture} object in {scene} into the {base_texture} object."
TOLERANCE = Tolerance(position_m=0.1)


@register_task("scene_understanding", family="simple_manipulation", template=TEMPLATE, oracle_max_steps=3)
def sample(
    table: TableSampler,
    *,
    num_distractors: int = 1,
    num_pictured_distractors: int = 1,
    difficulty: str = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: The table to lay.
        num_distractors: Further objects on the table, 0 … 3.
        num_pictured_distractors: Further objects in the picture, 0 … 3.
        difficulty: "easy", or "medium" and "hard", which mix and exchange the textures of the two roles.
    """
    check_count("num_distractors", num_distractors, high=3)
    check_count("num_pictured_distractors", num_pictured_distractors, high=3)
    dragged_textures, base_textures = textures_by_difficulty(table, difficulty)
    dragged_objects, base_objects = table.pool.dragged_objects, table.pool.base_objects
    objects, textures = (*dragged_objects, *base_objects), (*dragged_textures, *base_textures)
    apart_m = TOLERANCE.position_m  # nearer, and the episode would be decided at the start

    base_texture = target_texture = ""
    while base_texture == target_texture:
        base_texture, target_texture = table.choose(base_textures), table.choose(dragged_textures)
    base = table.place_one("base", lambda: (table.choose(base_objects), base_texture))
    target = table.place_one(
        "object to move", lambda: (table.choose(dragged_objects), target_texture), apart_m=apart_m
    )
    other_shapes = [name for name in dragged_objects if name != target.object]
    other_base_textures = [texture for texture in textures if texture != base.texture]

    def draw_distractor() -> tuple[str, str]:
        if table.rng.random() < 0.5:
            return table.choose(other_shapes), target.texture
        return base.object, table.choose(other_base_textures)

    distractors = table.place(
        "distractor", draw_distractor, count=num_distractors, tries=num_distractors + 20, apart_m=apart_m
    )
    picture = _picture(table, target, objects=objects, textures=textures, count=num_pictured_distractors)
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(
            TEMPLATE, dragged_texture=target.texture, scene=picture, base_texture=base.texture
        ),
        goals=(AtPose(target.id, base.pose, TOLERANCE, relative_to=base.id),),
        constraints=(DistractorsApart(tuple(d.id for d in distractors)),),
    )


def _picture(
    table: TableSampler,
    target: Placement,
    *,
    objects: tuple[str, ...],
    textures: tuple[str, ...],
    count: int,
) -> SceneImage:
    """Show the object to move somewhere else, among anything that has not its texture."""
    shown = table.blank()
    shown.place_one("pictured object", lambda: (target.object, target.texture), size=target.size)
    others = [texture for texture in textures if texture != target.texture]
    shown.place("pictured distractor", lambda: (shown.choose(objects), shown.choose(others)), count=count)
    return SceneImage.of(shown.placements)
