"""`scene_understanding`: put the object of one texture in a scene image into the base of another texture.

Scene:    a base, an object to move, and distractors: another shape in the object's texture, which only the
          image excludes, or a base of the same shape in another texture.
Prompt:   "Put the red swirl object in {scene} into the tiles object."
Success:  object within 0.1 m of the base's origin, while no distractor is as near to either of them.
Source:   VIMA paper, task list of the appendix, "Scene understanding".
"""

from openvima.scene import Placement, Problem, Prompt, SceneImage
from openvima.tasks.options import Difficulty, NumDistractors, textures_by_difficulty
from openvima.tasks.placing import APART_M, into_base, place_base_and_target
from openvima.tasks.registry import register_task
from openvima.tasks.table import Appearance, TableSampler

TEMPLATE = "Put the {dragged_texture} object in {scene} into the {base_texture} object."


@register_task(
    "scene_understanding", family="simple_object_manipulation", template=TEMPLATE, oracle_max_steps=3
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
        num_distractors: Distractors on the table, 0 … 6.
        difficulty: "easy", or "medium" and "hard", which mix and swap the textures of the two roles.
    """
    dragged_textures, base_textures = textures_by_difficulty(table, difficulty)
    textures = (*dragged_textures, *base_textures)

    base_texture = target_texture = ""
    while base_texture == target_texture:
        base_texture, target_texture = table.choose(base_textures), table.choose(dragged_textures)
    base, target = place_base_and_target(
        table, dragged_textures=(target_texture,), base_textures=(base_texture,)
    )
    other_shapes = [name for name in table.pool.dragged_objects if name != target.object]
    other_base_textures = [texture for texture in textures if texture != base.texture]

    def draw_distractor() -> Appearance:
        if table.rng.random() < 0.5:
            return table.choose(other_shapes), target.texture
        return base.object, table.choose(other_base_textures)

    distractors = table.place(
        "distractor", draw_distractor, count=num_distractors, tries=num_distractors + 20, apart_m=APART_M
    )
    prompt = Prompt.parse(
        TEMPLATE,
        dragged_texture=target.texture,
        scene=_prompt_scene(table, target, textures),
        base_texture=base.texture,
    )
    return into_base(table, prompt, target=target, base=base, distractors=distractors)


def _prompt_scene(table: TableSampler, target: Placement, textures: tuple[str, ...]) -> SceneImage:
    """Sample an image of the target beside an object of another texture."""
    sampler, objects = table.blank(), (*table.pool.dragged_objects, *table.pool.base_objects)
    others = [texture for texture in textures if texture != target.texture]

    def draw() -> Appearance:
        return sampler.choose(objects), sampler.choose(others)

    sampler.place_one("prompt object", lambda: (target.object, target.texture), size=target.size)
    sampler.place_one("prompt distractor", draw, tries=11)
    return SceneImage.of(sampler.placements)
