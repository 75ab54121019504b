"""`pick_in_order_then_restore`: move an object from base to base in the order of the prompt, then back.

Scene:    six bases of one shape, each of another texture, in two rows; an object in one of them.
Prompt:   "Put {dragged_obj} into {base_obj_1} then {base_obj_2}. Finally restore it into its original
          container."
Success:  object within 0.05 m of the origin of each base of the prompt in turn, then of its original base;
          it must not be in a base of the prompt before its turn.
Source:   VIMA paper, task list of the appendix, "Visual memory".
"""

from openvima.scene import (
    AtPose,
    InOrder,
    ObjectImage,
    Placement,
    Problem,
    Prompt,
    Tolerance,
)
from openvima.tasks.options import Difficulty
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler, grid_point

TEMPLATE = "Put {{dragged_obj}} into {targets}. Finally restore it into its original container."
TOLERANCE = Tolerance(position_m=0.05)
NUM_ROWS, NUM_COLUMNS = 2, 3
NUM_TARGETS = {"easy": 2, "medium": 2, "hard": 3}
_DEEP_BASES = ("bowl", "pallet")  # over which the object hovers higher in VIMA-Bench
_SPARE_STEPS = 2


def template(num_targets: int) -> str:
    """Return the prompt with slots for that many bases."""
    return TEMPLATE.format(targets=" then ".join(f"{{base_obj_{n + 1}}}" for n in range(num_targets)))


@register_task(
    "pick_in_order_then_restore",
    family="visual_reasoning",
    template=template(2),
    oracle_max_steps=4,
    distractors_allowed=True,
)
def sample(table: TableSampler, *, difficulty: Difficulty = "easy") -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        difficulty: "easy" and "medium" ask for two bases, "hard" for three.
    """
    pool, num_targets = table.pool, NUM_TARGETS[difficulty]
    centres = table.shuffled(
        [
            grid_point(row + 0.5, NUM_ROWS, column + 1, NUM_COLUMNS + 1)
            for row in range(NUM_ROWS)
            for column in range(NUM_COLUMNS)
        ]
    )
    name, texture = table.choose(pool.dragged_objects), table.choose(pool.dragged_textures)
    shape = table.choose(pool.base_objects)
    textures = table.distinct(pool.base_textures, len(centres))
    size, base_size = table.sample_size(name), table.sample_size(shape)

    def add_base(index: int) -> Placement:
        return table.add(shape, textures[index], size=base_size, pose=centres[index], fixed=True)

    if table.compat:
        z = (2.0 if shape in _DEEP_BASES else 0.5) * size[2]
        dragged = table.add(name, texture, size=size, pose=centres[0], fixed=False, z=z)
        source = add_base(0)
    else:
        source = add_base(0)
        start = table.centred_in(source, name, size) if source.object == "bowl" else centres[0]
        dragged = table.add(name, texture, size=size, pose=start, fixed=False, on_top=True)
    targets = [add_base(index) for index in range(1, len(centres))][:num_targets]
    images = {f"base_obj_{n}": ObjectImage(target) for n, target in enumerate(targets, 1)}
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(template(num_targets), dragged_obj=ObjectImage(dragged), **images),
        goals=tuple(AtPose.into(dragged, base, TOLERANCE) for base in (*targets, source)),
        constraints=(InOrder(tuple(range(1, num_targets))),),
        stages=(1,) * (num_targets + 1),
        oracle_max_steps=num_targets + _SPARE_STEPS,
    )
