"""A task of your own with a new word, "between". `python examples/custom_task.py` shows it."""

import openvima
from openvima.catalog import OBJECT_SETS, TEXTURE_SETS, Pool
from openvima.errors import SamplingError
from openvima.scene import AtPose, ObjectImage, Pose, Problem, Prompt, Tolerance
from openvima.tasks import TableSampler, register_task

TEMPLATE = "Put the {dragged_obj} between the {first_obj} and the {second_obj}."
SETS = {"train": ("D_train", "C1"), "L1": ("D_train", "C1"), "L2": ("D_train", "C2"), "L3": ("D_novel", "T")}
POOLS = {level: Pool(OBJECT_SETS[a], (), TEXTURE_SETS[b], ()) for level, (a, b) in SETS.items()}


@register_task(
    "put_between", family="visual_goal_reaching", template=TEMPLATE, oracle_max_steps=2, pools=POOLS
)
def sample(table: TableSampler, *, tolerance_m: float = 0.05) -> Problem:
    """Sample one problem; keyword arguments are the task's options.

    Args:
        table: Samples objects and their poses.
        tolerance_m: Largest distance from the middle, in metres.
    """

    def draw():
        return table.choose(table.pool.dragged_objects), table.choose(table.pool.dragged_textures)

    first, second = table.place("neighbour", draw, count=2, tries=20)
    if not 0.3 < first.pose.planar_distance(second.pose) < 0.6:
        raise SamplingError("the neighbours are too near or too far")  # the episode is sampled again
    middle = Pose.planar((first.pose.x + second.pose.x) / 2, (first.pose.y + second.pose.y) / 2)
    dragged = table.place_one("dragged object", draw, reject=lambda p: p.pose.planar_distance(middle) < 0.15)
    if len({(p.object, p.texture) for p in (first, second, dragged)}) < 3:
        raise SamplingError("two of the three are identical")
    images = {"dragged_obj": dragged, "first_obj": first, "second_obj": second}
    prompt = Prompt.parse(TEMPLATE, **{name: ObjectImage(image) for name, image in images.items()})
    return Problem(table.scene(), prompt, goals=(AtPose(dragged.id, middle, Tolerance(tolerance_m)),))


if __name__ == "__main__":
    env = openvima.make("put_between", level="L1")
    for seed in range(5):
        _, info = env.reset(seed=seed)
        *_, info = env.step(env.oracle_decision().action)
        print(info["prompt"], "→ solved" if info["success"] else f"→ not solved {info['reason']}")
