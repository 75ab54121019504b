"""`follow_order`: stack objects in the order of video frames.

Scene:    three or four objects of one shape in a row, and distractors of other shapes.
Prompt:   "Stack objects in this order {frame_0} {frame_1} {frame_2}." The frames contain no
          distractors; from frame to frame the topmost object of one stack moves onto another.
Success:  every step brings the right object within 0.1 m of its position in the next frame, at any height;
          the first step that does not is a failure.
Source:   VIMA paper, task list of the appendix, "Follow order".
"""

import functools
import itertools
from collections.abc import Iterator

from openvima.scene import WORKSPACE_LOW, EveryStepCounts, Placement, Pose, Problem
from openvima.tasks.options import Difficulty, NumDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.scene_prompts import (
    NUM_FRAMES,
    Frame,
    goals_between,
    video_problem,
    with_frame_slots,
)
from openvima.tasks.table import TableSampler

TEMPLATE = "Stack objects in this order {frames}."
NUM_BLOCKS = {"easy": 3, "medium": 4, "hard": 4}
_SPARE_STEPS = 2

Stacks = tuple[tuple[int, ...], ...]
"""Blocks at each place of the row, bottom to top."""


@register_task(
    "follow_order",
    family="one_shot_video_imitation",
    template=with_frame_slots(TEMPLATE, NUM_FRAMES["easy"]),
    oracle_max_steps=NUM_FRAMES["easy"] - 1 + _SPARE_STEPS,
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
        num_distractors: Further objects, 0 … 6.
        difficulty: "easy", "medium" or "hard": 3, 4 or 4 objects in 3, 4 or 5 frames.
    """
    num_frames, num_blocks = NUM_FRAMES[difficulty], NUM_BLOCKS[difficulty]
    objects, textures = table.pool.dragged_objects, table.pool.dragged_textures

    shape = table.choose(objects)
    block_textures = table.distinct(textures, num_blocks)
    stackings = table.choose(all_stackings(num_blocks, num_frames - 1))
    size = table.sample_size(shape)
    blocks = [
        table.add(shape, texture, size=size, pose=place)
        for texture, place in zip(block_textures, _row(num_blocks), strict=True)
    ]
    other_shapes = [name for name in objects if name != shape]
    table.place(
        "distractor",
        table.drawing(other_shapes, textures),
        count=num_distractors,
        tries=num_distractors + 10,
    )

    frames = [_stack(table, blocks, stacks) for stacks in stackings]
    images = [_by_place(frame) for frame in frames] if table.compat else frames
    goals = goals_between(frames)
    return video_problem(table.scene(), TEMPLATE, images, goals, EveryStepCounts(), spare_steps=_SPARE_STEPS)


@functools.cache
def all_stackings(num_blocks: int, num_moves: int) -> tuple[tuple[Stacks, ...], ...]:
    """Return all sequences of moves of one topmost block at a time, from a row of single blocks.

    A sequence lists the stacks before the first move and after each; moves may undo earlier ones.
    """
    ways: list[tuple[Stacks, ...]] = [(tuple((block,) for block in range(num_blocks)),)]
    for _ in range(num_moves):
        ways = [(*way, after) for way in ways for after in _after_one_move(way[-1])]
    return tuple(ways)


def _after_one_move(stacks: Stacks) -> Iterator[Stacks]:
    for source, target in itertools.permutations(range(len(stacks)), 2):
        if stacks[source]:
            changed = list(stacks)
            changed[source] = stacks[source][:-1]
            changed[target] = (*stacks[target], stacks[source][-1])
            yield tuple(changed)


def _row(num_places: int) -> list[Pose]:
    """Evenly spaced places along the table."""
    distance_m = -2 * WORKSPACE_LOW[1] / (num_places + 1)
    return [Pose.planar(0.5, WORKSPACE_LOW[1] + n * distance_m) for n in range(1, num_places + 1)]


def _stack(table: TableSampler, blocks: list[Placement], stacks: Stacks) -> Frame:
    """Place the blocks in stacks; with `compat` spaced by nominal height."""
    sampler, poses = table.blank(), {}
    for stack, place in zip(stacks, _row(len(stacks)), strict=True):
        for level, index in enumerate(stack):
            block = blocks[index]
            z = (2 * level + 1) * block.size[2] / 2 if table.compat else None
            placed = sampler.add(
                block.object, block.texture, size=block.size, pose=place, z=z, on_top=level > 0
            )
            poses[index] = placed.pose
    return [block.at(poses[index]) for index, block in enumerate(blocks)]


def _by_place(frame: Frame) -> Frame:
    """Sort blocks along the row, stacks from bottom to top."""
    return sorted(frame, key=lambda block: (block.pose.y, block.pose.z))
