"""A task of your own in one file: put an object between two others.

Run it with `python examples/custom_task.py`: the oracle solves it. On the command line, name the file:

    OPENVIMA_TASK_FILES=examples/custom_task.py openvima demo put_between --out put_between.mp4
"""

from openvima.catalog import OBJECT_SETS, TEXTURE_SETS, Level, Pool
from openvima.errors import SamplingError
from openvima.scene import AtPose, ObjectImage, Pose, Problem, Prompt, Tolerance
from openvima.tasks import TableSampler, register_task

TEMPLATE = "Put the {dragged_obj} between the {first_obj} and the {second_obj}."
TOLERANCE = Tolerance(position_m=0.05)
GAP_M = (0.3, 0.6)  # between the two others: wide enough for a third


def pool(objects: str, textures: str) -> Pool:
    """Movable objects of one set of shapes and one of textures, without bases."""
    return Pool(OBJECT_SETS[objects], (), TEXTURE_SETS[textures], ())


POOLS: dict[Level, Pool] = {
    "train": pool("D_train", "C1"),
    "L1": pool("D_train", "C1"),  # new placements
    "L2": pool("D_train", "C2"),  # new combinations
    "L3": pool("D_novel", "T"),  # new shapes and textures
}


@register_task(
    "put_between", family="visual_goal_reaching", template=TEMPLATE, oracle_max_steps=2, pools=POOLS
)
def sample(table: TableSampler, *, tolerance_m: float = TOLERANCE.position_m) -> Problem:
    """Sample one problem; keyword arguments are the task's options."""

    def draw() -> tuple[str, str]:
        return table.choose(table.pool.dragged_objects), table.choose(table.pool.dragged_textures)

    first, second = table.place("neighbour", draw, count=2, tries=20)
    if not GAP_M[0] < first.pose.planar_distance(second.pose) < GAP_M[1]:
        raise SamplingError("the neighbours are too near or too far")  # resampled
    middle = Pose.planar((first.pose.x + second.pose.x) / 2, (first.pose.y + second.pose.y) / 2)
    dragged = table.place_one("dragged object", draw, reject=lambda p: p.pose.planar_distance(middle) < 0.15)
    if len({(p.object, p.texture) for p in (first, second, dragged)}) < 3:
        raise SamplingError("two of the three are identical")
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(
            TEMPLATE,
            dragged_obj=ObjectImage(dragged),
            first_obj=ObjectImage(first),
            second_obj=ObjectImage(second),
        ),
        goals=(AtPose(dragged.id, middle, Tolerance(tolerance_m)),),
    )


if __name__ == "__main__":
    import openvima

    env = openvima.make("put_between", level="L1")
    for seed in range(5):
        _, info = env.reset(seed=seed)
        *_, info = env.step(env.oracle_decision().action)
        print(info["prompt"], "→ solved" if info["success"] else f"→ not solved {info['reason']}")
