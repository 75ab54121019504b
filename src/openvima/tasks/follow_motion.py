"""`follow_motion`: repeat the motion of an object in video frames.

Scene:    an object on one of five points of a circle, and a distractor in the middle of it.
Prompt:   "Follow this motion for {dragged_obj}: {frame_0} {frame_1} {frame_2}." In the frames another
          distractor is in the middle, and the object moves between neighbouring points.
Success:  every step brings the object within 0.1 m of its position in the next frame; the first step that
          does not is a failure.
Source:   VIMA paper, task list of the appendix, "Follow motion".
"""

import math
from itertools import accumulate

from openvima.scene import EveryStepCounts, ObjectImage, Placement, Pose, Problem
from openvima.tasks.options import Difficulty, NumDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.scene_prompts import (
    NUM_FRAMES,
    goals_between,
    video_problem,
    with_frame_slots,
)
from openvima.tasks.table import Appearance, TableSampler

TEMPLATE = "Follow this motion for {dragged_obj}: {frames}."
CENTRE = Pose.planar(0.5, 0.0)
RADIUS_M = 0.19
CIRCLE_MARGIN_M = 0.1  # of further distractors
NUM_POINTS = 5  # 0.22 m from each other, 0.19 m from the centre


@register_task(
    "follow_motion",
    family="one_shot_video_imitation",
    template=with_frame_slots(TEMPLATE, NUM_FRAMES["easy"]),
    oracle_max_steps=NUM_FRAMES["easy"] - 1,
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
        num_distractors: Distractors on the table, 0 … 6: one in the middle, the others away from the circle.
        difficulty: "easy", "medium" or "hard": 3, 4 or 5 frames.
    """
    num_frames = NUM_FRAMES[difficulty]
    appearances = table.appearances()
    appearance = table.choose(appearances)
    other_appearances = [other for other in appearances if other != appearance]

    walk = _sample_walk(table, num_frames)
    dragged = _put(table, appearance, walk[0])
    if num_distractors:
        _put(table, table.choose(other_appearances), CENTRE)
    in_frames = _put(table.blank(), table.choose(other_appearances), CENTRE)

    table.place(
        "distractor",
        lambda: table.choose(other_appearances),
        count=max(num_distractors - 1, 0),
        tries=20 * max(num_distractors, 1),
        reject=_is_near_circle,
    )

    frames = [(dragged.at(place.moved(dz=dragged.pose.z)),) for place in walk]
    return video_problem(
        table.scene(),
        TEMPLATE,
        [(*frame, in_frames) for frame in frames],
        goals_between(frames),
        EveryStepCounts(),
        spare_steps=0,
        dragged_obj=ObjectImage(dragged),
    )


def _sample_walk(table: TableSampler, num_places: int) -> list[Pose]:
    """Draw a random walk between neighbouring points of the circle."""
    start = int(table.rng.integers(NUM_POINTS))
    steps = (table.choose((-1, 1)) for _ in range(num_places - 1))
    angles = (2 * math.pi * point / NUM_POINTS for point in accumulate(steps, initial=start))
    return [CENTRE.moved(RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle)) for angle in angles]


def _is_near_circle(placement: Placement) -> bool:
    return placement.pose.planar_distance(CENTRE) < RADIUS_M + CIRCLE_MARGIN_M


def _put(table: TableSampler, appearance: Appearance, pose: Pose) -> Placement:
    size = table.sample_size(appearance[0])
    return table.add(*appearance, size=size, pose=pose, z=size[2] if table.compat else None)
