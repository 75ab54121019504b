"""Augmentation of batches: false positives, and shuffled objects.

Shape suffixes: B batch, T steps, V views, N objects in view (slots of a view).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from openvima.policies.batch import Batch, HistoryBatch
from openvima.render.camera import VIEWS

NUM_VIEWS = len(VIEWS)
MOST_SLOTS = 256  # numbers drawn for a step; more than there are ids
_LAST = 1e6  # sorts after every slot


def augmented(
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
    drawn = _drawn(batch.history, rngs)
    shows_BTV = drawn[..., :NUM_VIEWS] < probability
    shows_BTV &= batch.history.steps_BT[..., None]
    if layout == "views":
        return _with_spurious_in_views(batch, shows_BTV, drawn[..., NUM_VIEWS : 2 * NUM_VIEWS])
    history = batch.history
    is_slot = torch.arange(history.positions_BTN2.shape[2]) < history.num_slots_BT[..., None]
    keys_BTN = torch.cat(  # padding of the batch stays at the end
        [torch.where(is_slot, drawn[..., 2 * NUM_VIEWS :], _LAST), drawn[..., NUM_VIEWS : 2 * NUM_VIEWS]], -1
    )
    return _shuffled(replace(batch, history=_with_spurious_objects(batch, shows_BTV)), keys_BTN)


def _drawn(history: HistoryBatch, rngs: Sequence[np.random.Generator]) -> torch.Tensor:
    """Numbers from 0 to 1 for all views and slots of each step, shape (B, T, 2 V + N), float32."""
    num_steps, num_slots = history.steps_BT.shape[1], history.positions_BTN2.shape[2]
    drawn = np.zeros((len(rngs), num_steps, 2 * NUM_VIEWS + num_slots), np.float32)
    for b, (rng, count) in enumerate(zip(rngs, history.steps_BT.sum(dim=1).tolist(), strict=True)):
        drawn[b, :count] = rng.random((count, MOST_SLOTS), np.float32)[:, : drawn.shape[2]]
    return torch.from_numpy(drawn)


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
    views = _in_order(history, rank_BTVN.argsort(dim=3))
    return replace(batch, history=replace(views, num_slots_BT=num_slots_BT))


def _shuffled(batch: Batch, keys_BTN: torch.Tensor) -> Batch:
    """Put the objects of every step into the order of numbers drawn for them."""
    history = batch.history
    order_BTN = keys_BTN.argsort(dim=-1, stable=True)
    place_BTN = order_BTN.argsort(dim=-1)  # where each old slot has gone
    order_BTN2 = order_BTN[..., None].expand_as(history.positions_BTN2)
    views = _in_order(history, order_BTN[:, :, None].expand_as(history.crop_index_BTVN))
    moved = replace(
        views,
        positions_BTN2=history.positions_BTN2.gather(2, order_BTN2),
        grasps_BTN2=history.grasps_BTN2.gather(2, order_BTN2),
    )
    targets = replace(
        batch.targets,
        pick_BT=_moved(batch.targets.pick_BT, place_BTN),
        place_BT=_moved(batch.targets.place_BT, place_BTN),
    )
    return replace(batch, history=moved, targets=targets)


def _in_order(history: HistoryBatch, order_BTVN: torch.Tensor) -> HistoryBatch:
    """Reorder what views show of the objects."""
    return replace(
        history,
        crop_index_BTVN=history.crop_index_BTVN.gather(3, order_BTVN),
        boxes_BTVN4=history.boxes_BTVN4.gather(3, order_BTVN[..., None].expand_as(history.boxes_BTVN4)),
        masks_BTVN=history.masks_BTVN.gather(3, order_BTVN),
    )


def _moved(slot_BT: torch.Tensor, place_BTN: torch.Tensor) -> torch.Tensor:
    new_BT = place_BTN.gather(2, slot_BT.clamp(min=0)[..., None]).squeeze(2)
    return torch.where(slot_BT >= 0, new_BT, slot_BT)
