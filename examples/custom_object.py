"""An object, a texture and a goal of your own, in a small task that the oracle solves."""

from typing import NamedTuple

import numpy as np

import openvima
from openvima.catalog import Pool, register_object, register_texture
from openvima.scene import AtPose, ObjectImage, Pose, Problem, Prompt, Scene, Tolerance
from openvima.tasks import TableSampler, register_task

CORNERS = np.array([(0, 0, 0), (6, 0, 0), (6, 6, 0), (0, 6, 0), (3, 3, 4)])  # in any unit
TRIANGLES = np.array([(0, 2, 1), (0, 3, 2), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)])
register_object("pyramid", (CORNERS, TRIANGLES), size=(0.12, 0.12, 0.08), symmetry_deg=90)  # in metres
register_texture("zebra", np.tile(np.repeat(np.uint8([[[0]], [[255]]]), 8, axis=0), (4, 64, 3)))
POOL = Pool(dragged_objects=("pyramid",), dragged_textures=("zebra",), base_objects=(), base_textures=())


class OnTheRight(NamedTuple):  # a goal is anything with `is_met`
    object_id: int

    def is_met(self, scene: Scene) -> bool:
        return scene[self.object_id].pose.y > 0.2

    def oracle_move(self, scene: Scene) -> AtPose:  # optional: what the oracle does to meet it
        return AtPose(self.object_id, Pose.planar(0.5, 0.35), Tolerance(0.05))


@register_task("right", family="own", template="Put {it} right.", oracle_max_steps=1, pools={"train": POOL})
def sample(table: TableSampler) -> Problem:
    """Sample a pyramid elsewhere."""
    it = table.place_one("pyramid", lambda: ("pyramid", "zebra"), reject=lambda p: p.pose.y > 0.1)
    return Problem(table.scene(), Prompt.parse("Put {it} right.", it=ObjectImage(it)), (OnTheRight(it.id),))


if __name__ == "__main__":
    env = openvima.make("right")
    env.reset(seed=0)
    *_, info = env.step(env.oracle_decision().action)
    print("solved" if info["success"] else info["reason"])
