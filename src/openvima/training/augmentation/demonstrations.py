"""Augmentation of demonstrations, listed in the order of the draws, and false positives in their batches.

Shape suffixes: B batch, T steps, V views, N objects in view (slots of a view).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import torch

from openvima.data.preprocessed import PreprocessedEpisode
from openvima.errors import UnknownTaskError
from openvima.perception.boxes import box_iou
from openvima.perception.objects import TOP
from openvima.perception.preprocessing import ObjectTable
from openvima.policies.batch import Batch, HistoryBatch
from openvima.policies.nn.actions import ACTION_PARTS, carry
from openvima.render.camera import CAMERAS, VIEWS, unproject
from openvima.tasks.registry import task_spec
from openvima.training.augmentation.prompts import (
    describe_objects,
    mask_words,
    paraphrase,
    rename_objects,
    shuffle_prompt_objects,
    shuffle_sentences,
    turn_comparisons,
    with_motion_prompt,
    with_unused_definitions,
)
from openvima.training.config import AugmentationConfig

PICK, PLACE = ACTION_PARTS["pose0_position"], ACTION_PARTS["pose1_position"]


def drop_unused_objects(
    episode: PreprocessedEpisode, rng: np.random.Generator, *, prob: float
) -> PreprocessedEpisode:
    """Drop unused objects from the observations, and others from the prompt frames.

    Args:
        episode: The demonstration, with the ids of the segmentation.
        rng: Draws the objects.
        prob: Probability of the first for each unused object, and of the second for each that is left.
    """
    ids = np.setdiff1d(episode.objects.ids, [episode.pick_ids, episode.place_ids])
    is_unobserved, is_unprompted = rng.random((2, len(ids))) < prob
    prompt = episode.prompt
    observed = ~np.isin(episode.objects.ids, ids[is_unobserved])
    prompted = ~np.isin(prompt.objects.ids, ids[is_unprompted & ~is_unobserved])
    return replace(
        episode,
        objects=episode.objects.select(observed),
        objects_per_step=_count_kept(episode.objects_per_step, observed),
        prompt=replace(
            prompt,
            objects=prompt.objects.select(prompted),
            objects_per_image=_count_kept(prompt.objects_per_image, prompted),
        ),
    )


def _count_kept(counts: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Count the kept rows of each group."""
    group = np.repeat(np.arange(len(counts)), counts)
    return np.bincount(group[kept], minlength=len(counts)).astype(counts.dtype)


MAX_DISTRACTORS = 3


@cache
def allows_distractors(task: str) -> bool:
    """Whether demonstrations of a task stay correct with distractors, see `TaskSpec.distractors_allowed`."""
    try:
        return task_spec(task).distractors_allowed
    except UnknownTaskError:  # demonstrations of a task that is not installed here
        return False


def with_distractors(
    episode: PreprocessedEpisode, other: PreprocessedEpisode, rng: np.random.Generator
) -> PreprocessedEpisode:
    """Insert up to three objects of another demonstration, where they are, at all steps.

    Their boxes overlap no other box of any step. Only table rows are copied, no images. In few episodes a
    distractor matches the prompt as well as the target does, which makes the prompt ambiguous.

    Args:
        episode: The demonstration.
        other: Distractors come from its first step; the images of both are numbered in one stack.
        rng: Draws how many, and which.
    """
    count = rng.integers(1, MAX_DISTRACTORS + 1)
    there = other.objects.select(slice(0, int(other.objects_per_step[0])))
    there = there.select(rng.permutation(len(there)))
    there = there.select(np.asarray(there.masks.all(axis=1)))
    taken = box_iou(*_boxes_by_view(there), *_boxes_by_view(episode.objects)) > 0
    there = there.select(np.flatnonzero(~taken.any(axis=1))[:count])
    there = replace(there, ids=episode.objects.ids.max(initial=-1) + 1 + np.arange(len(there)))
    steps = episode.objects.split(episode.objects_per_step)
    objects = ObjectTable.concatenate([table for step in steps for table in (step, there)])
    objects_per_step = episode.objects_per_step + len(there)
    return replace(episode, objects=objects, objects_per_step=objects_per_step)


def _boxes_by_view(objects: ObjectTable) -> tuple[np.ndarray, np.ndarray]:
    """Boxes, (2, N, 4), and visibility, (2, N)."""
    return objects.boxes.swapaxes(0, 1), objects.masks.T


def centre_picks(episode: PreprocessedEpisode) -> PreprocessedEpisode:
    """Move picks to the centre of the box of their object, and places so that it ends as before.

    Demonstrated picks are random points of an object. Bins cannot predict which one, so they learn the choice
    of the object through noise of two nats a coordinate. Policies that read positions from objects pick at
    the centre as well. Sweeps stay as they are.
    """
    if episode.end_effector:
        return episode
    step = np.repeat(np.arange(episode.num_steps), episode.objects_per_step)
    is_picked = (episode.objects.ids == episode.pick_ids[step]) & episode.objects.masks[:, TOP]
    step = step[is_picked]
    points = unproject(episode.objects.boxes[is_picked, TOP, :2], CAMERAS["top"])
    actions = episode.actions.copy()
    actions[step, PLACE] = carry(torch.from_numpy(actions[step]), torch.from_numpy(points)).numpy()
    actions[step, PICK] = points
    return replace(episode, actions=actions)


def augment(
    episode: PreprocessedEpisode,
    config: AugmentationConfig,
    rng: np.random.Generator | None,
    *,
    other: PreprocessedEpisode | None = None,
    definer: PreprocessedEpisode | None = None,
    keeps_prompt: bool = False,
) -> PreprocessedEpisode:
    """Augment a demonstration, which then has an inverse-dynamics prompt or that of its task.

    Args:
        episode: The demonstration.
        config: Probabilities of what happens to it.
        rng: Source of all draws; None, as in validation: only what is certain happens.
        other: A demonstration from which distractors are inserted; None inserts none.
        definer: One from whose prompt unused definitions are inserted; None inserts none.
        keeps_prompt: Whether no draw exchanges the prompt for that of inverse dynamics.
    """
    if config.centre_picks:
        episode = centre_picks(episode)
    prob = config.inverse_dynamics_prob
    is_drawn = rng is not None and prob > 0 and rng.random() < prob and not keeps_prompt
    is_inverse = prob == 1 or is_drawn
    if is_inverse:
        episode = with_motion_prompt(episode)
    if rng is None:
        return episode
    if is_inverse:
        if config.drop_unused_objects_prob:
            episode = drop_unused_objects(episode, rng, prob=config.drop_unused_objects_prob)
    else:
        if other is not None:
            episode = with_distractors(episode, other, rng)
        for prob, change in (
            (config.paraphrase_prob, paraphrase),  # before others change the text
            (config.rename_objects_prob, rename_objects),
            (config.turn_comparisons_prob, turn_comparisons),
            (config.shuffle_sentences_prob, shuffle_sentences),
        ):
            if prob and rng.random() < prob:
                episode = change(episode, rng)
        if config.describes_objects:  # after those that look for images
            episode = describe_objects(episode, rng, config)
        if config.unknown_word_prob:
            episode = mask_words(episode, rng, prob=config.unknown_word_prob)
    prob = config.shuffle_prompt_objects_prob
    if prob and rng.random() < prob:
        episode = shuffle_prompt_objects(episode, rng)
    if definer is not None and not is_inverse:
        episode = with_unused_definitions(episode, definer, rng)
    return episode


NUM_VIEWS = len(VIEWS)
MOST_SLOTS = 256  # numbers drawn for a step; more than there are ids
_LAST = 1e6  # sorts after every slot


def add_false_positives(
    batch: Batch,
    layout: Literal["objects", "views", "frames"],
    *,
    probability: float,
    rngs: Sequence[np.random.Generator],
) -> Batch:
    """Add false positives, and shuffle objects where their order has no meaning.

    Args:
        batch: Demonstrations.
        layout: Token layout of the `Processor`. Fused objects are shuffled, as the head points at them. With
            a token for each view they keep their order, as in the published policies, and false positives
            anywhere among them. Whole frames stay as they are.
        probability: Probability that a view of a step contains a false positive.
        rngs: One for each demonstration; draws depend neither on the rest of the batch nor on padding.

    Returns:
        The batch with two more slots for objects; targets follow their objects.
    """
    if layout == "frames":
        return batch
    # Numbers from 0 to 1 for all views and slots of each step, (B, T, 2 V + N).
    num_steps, num_slots = batch.history.steps_BT.shape[1], batch.history.positions_BTN2.shape[2]
    numbers = np.zeros((len(rngs), num_steps, 2 * NUM_VIEWS + num_slots), np.float32)
    for b, (rng, count) in enumerate(zip(rngs, batch.history.steps_BT.sum(dim=1).tolist(), strict=True)):
        numbers[b, :count] = rng.random((count, MOST_SLOTS), np.float32)[:, : numbers.shape[2]]
    drawn = torch.from_numpy(numbers)
    shows_BTV = drawn[..., :NUM_VIEWS] < probability
    shows_BTV &= batch.history.steps_BT[..., None]
    if layout == "views":
        return _with_spurious_in_views(batch, shows_BTV, drawn[..., NUM_VIEWS : 2 * NUM_VIEWS])
    history = batch.history
    is_slot = torch.arange(num_slots) < history.num_slots_BT[..., None]
    keys_BTN = torch.cat(  # padding of the batch stays at the end
        [torch.where(is_slot, drawn[..., 2 * NUM_VIEWS :], _LAST), drawn[..., NUM_VIEWS : 2 * NUM_VIEWS]], -1
    )
    return _shuffle_slots(replace(batch, history=_with_spurious_objects(batch, shows_BTV)), keys_BTN)


def _with_spurious_objects(batch: Batch, shows_BTV: torch.Tensor) -> HistoryBatch:
    """Append a slot for each view; slot N + v is the false positive of view v, or nothing."""
    history, false_positives = batch.history, batch.false_positives
    visible_BTVN = torch.diag_embed(shows_BTV)  # view v, slot v
    crop_index_BTVN = torch.diag_embed(torch.from_numpy(false_positives.crop_index)) * visible_BTVN
    boxes_BTV4 = torch.from_numpy(false_positives.boxes)
    boxes_BTVN4 = boxes_BTV4[:, :, :, None] * visible_BTVN[..., None]
    points_BTN2 = torch.from_numpy(false_positives.points)
    return replace(
        history,
        crop_index_BTVN=torch.cat([history.crop_index_BTVN, crop_index_BTVN], dim=3),
        boxes_BTVN4=torch.cat([history.boxes_BTVN4, boxes_BTVN4], dim=3),
        masks_BTVN=torch.cat([history.masks_BTVN, visible_BTVN], dim=3),
        num_slots_BT=history.num_slots_BT + NUM_VIEWS,
        positions_BTN2=torch.cat([history.positions_BTN2, points_BTN2], dim=2),
        grasps_BTN2=torch.cat([history.grasps_BTN2, points_BTN2], dim=2),
    )


def _with_spurious_in_views(batch: Batch, shows_BTV: torch.Tensor, drawn_BTV: torch.Tensor) -> Batch:
    """Put false positives anywhere among the visible slots of their view.

    The numbers of slots become what `Processor` would make of such detections: each is an object that one
    view shows, so that the other view gets an empty slot; and slots once there stay for the episode.
    """
    history = _with_spurious_objects(batch, shows_BTV)
    num_visible_BTV = batch.history.masks_BTVN.sum(dim=3)
    place_BTV = (drawn_BTV * (num_visible_BTV + 1)).floor() - 0.5
    num_slots = history.masks_BTVN.shape[3]
    rank_BTVN = torch.arange(num_slots).expand(history.masks_BTVN.shape).to(torch.float32)
    rank_BTVN = torch.where(history.masks_BTVN, rank_BTVN, rank_BTVN + _LAST)
    rank_BTVN[..., -NUM_VIEWS:] = torch.where(
        torch.diag_embed(shows_BTV), place_BTV[..., None], rank_BTVN[..., -NUM_VIEWS:]
    )
    num_slots_BT = (batch.history.num_slots_BT + shows_BTV.sum(dim=2)).cummax(dim=1).values
    num_slots_BT = torch.where(history.steps_BT, num_slots_BT, 0)
    order_BTVN = rank_BTVN.argsort(dim=3)
    order_BTN2 = order_BTVN[:, :, TOP, :, None].expand_as(history.grasps_BTN2)
    grasps_BTN2 = history.grasps_BTN2.gather(2, order_BTN2)
    views = replace(_reorder(history, order_BTVN), grasps_BTN2=grasps_BTN2)
    return replace(batch, history=replace(views, num_slots_BT=num_slots_BT))


def _shuffle_slots(batch: Batch, keys_BTN: torch.Tensor) -> Batch:
    """Put the objects of every step into the order of numbers drawn for them."""
    history = batch.history
    order_BTN = keys_BTN.argsort(dim=-1, stable=True)
    place_BTN = order_BTN.argsort(dim=-1)  # where each old slot has gone
    order_BTN2 = order_BTN[..., None].expand_as(history.positions_BTN2)
    views = _reorder(history, order_BTN[:, :, None].expand_as(history.crop_index_BTVN))
    moved = replace(
        views,
        positions_BTN2=history.positions_BTN2.gather(2, order_BTN2),
        grasps_BTN2=history.grasps_BTN2.gather(2, order_BTN2),
    )
    targets = replace(
        batch.targets,
        pick_BT=_follow_slots(batch.targets.pick_BT, place_BTN),
        place_BT=_follow_slots(batch.targets.place_BT, place_BTN),
    )
    return replace(batch, history=moved, targets=targets)


def _reorder(history: HistoryBatch, order_BTVN: torch.Tensor) -> HistoryBatch:
    """Reorder what views show of the objects."""
    return replace(
        history,
        crop_index_BTVN=history.crop_index_BTVN.gather(3, order_BTVN),
        boxes_BTVN4=history.boxes_BTVN4.gather(3, order_BTVN[..., None].expand_as(history.boxes_BTVN4)),
        masks_BTVN=history.masks_BTVN.gather(3, order_BTVN),
    )


def _follow_slots(slot_BT: torch.Tensor, place_BTN: torch.Tensor) -> torch.Tensor:
    new_BT = place_BTN.gather(2, slot_BT.clamp(min=0)[..., None]).squeeze(2)
    return torch.where(slot_BT >= 0, new_BT, slot_BT)
