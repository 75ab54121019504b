"""`imitate_then_undo`: move objects as a video of six frames shows, then undo all moves in reverse order.

Scene:    three objects on the table, and a distractor that no frame shows.
Prompt:   "Rearrange objects in this order {frame_0} … {frame_5} and then restore." One object moves from
          frame to frame; the first one shows the start.
Success:  the moved object of each frame within 0.1 m of its place there, in the order of the frames, then of
          its place before, from the last frame to the first; at the end the distractor is as near to none of
          these places.
Source:   level L8 of openvima; not in the VIMA paper.
"""

from openvima.scene import AtPose, DistractorsApart, Placement, Problem
from openvima.tasks.options import FewDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.scene_prompts import goals_between, video_problem, with_frame_slots
from openvima.tasks.table import Appearance, TableSampler

TEMPLATE = "Rearrange objects in this order {frames} and then restore."
NUM_FRAMES, NUM_OBJECTS = 6, 3
APART_M = 0.15
_TRIES = 40
_SPARE_STEPS = 2


@register_task(
    "imitate_then_undo",
    family="one_shot_video_imitation",
    template=with_frame_slots(TEMPLATE, NUM_FRAMES),
    oracle_max_steps=2 * (NUM_FRAMES - 1) + _SPARE_STEPS,
)
def sample(table: TableSampler, *, num_distractors: FewDistractors = 1) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Further objects, 0 … 3.
    """
    taken: set[Appearance] = set()

    def put(what: str) -> Placement:
        appearance = table.choose([each for each in table.appearances() if each not in taken])
        taken.add(appearance)
        return table.place_one(what, lambda: appearance, tries=_TRIES, apart_m=APART_M)

    objects = [put("object") for _ in range(NUM_OBJECTS)]
    distractors = [put("distractor") for _ in range(num_distractors)]
    scene, frames, last = table.scene(), [tuple(objects)], -1
    for _ in range(NUM_FRAMES - 1):
        last = table.choose([n for n in range(NUM_OBJECTS) if n != last])
        frame = list(frames[-1])
        before = frame[last]
        place = table.find_place(
            "place in the next frame",
            before,
            tries=_TRIES,
            apart_m=APART_M,
            reject=lambda new, old=before: new.pose.planar_distance(old.pose) < APART_M,
        )
        frame[last] = table.move(before, place)
        frames.append(tuple(frame))
    goals: tuple[AtPose, ...] = (*goals_between(frames), *goals_between(frames[::-1]))
    apart = DistractorsApart.of(distractors, at_end=True)
    return video_problem(scene, TEMPLATE, frames, goals, apart, spare_steps=_SPARE_STEPS)
