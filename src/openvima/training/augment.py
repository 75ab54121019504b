"""Augmentation of batches: false detections among the objects, and objects in any order.

Shape suffixes: B batch, T steps, V views, N objects in view.
"""

from dataclasses import replace

import torch

from openvima.policies.inputs import HistoryBatch
from openvima.training.dataset import Batch

NUM_VIEWS = 2


def augmented(batch: Batch, *, probability: float, generator: torch.Generator) -> Batch:
    """Add false detections and shuffle the objects of every step.

    Args:
        batch: Demonstrations with fused views.
        probability: Chance that a view of a step shows an object that is none.
        generator: Draws both.

    Returns:
        The batch with two more slots, one for each view; targets follow their objects.
    """
    history = _with_spurious(batch, probability, generator)
    shape = history.positions_BTN2.shape[:3]
    order_BTN = torch.rand(shape, generator=generator).argsort(dim=-1)
    place_BTN = order_BTN.argsort(dim=-1)  # where each old slot has gone
    targets = replace(
        batch.targets,
        pick_BT=_moved(batch.targets.pick_BT, place_BTN),
        place_BT=_moved(batch.targets.place_BT, place_BTN),
    )
    return replace(batch, history=_reordered(history, order_BTN), targets=targets)


def _with_spurious(batch: Batch, probability: float, generator: torch.Generator) -> HistoryBatch:
    """Append a slot for each view; slot N + v shows the false detection of view v, or nothing."""
    history, spurious = batch.history, batch.spurious
    shape = history.steps_BT.shape
    shows_BTV = torch.rand(*shape, NUM_VIEWS, generator=generator) < probability
    shows_BTV &= history.steps_BT[..., None]
    visible_BTVN = torch.diag_embed(shows_BTV)  # view v, slot v
    crops_BTVN = torch.diag_embed(torch.from_numpy(spurious.crops)) * visible_BTVN
    boxes_BTV4 = torch.from_numpy(spurious.boxes)
    boxes_BTVN4 = boxes_BTV4[:, :, :, None] * visible_BTVN[..., None]
    points_BTN2 = torch.from_numpy(spurious.points)
    return replace(
        history,
        crops_BTVN=torch.cat([history.crops_BTVN, crops_BTVN], dim=3),
        boxes_BTVN4=torch.cat([history.boxes_BTVN4, boxes_BTVN4], dim=3),
        masks_BTVN=torch.cat([history.masks_BTVN, visible_BTVN], dim=3),
        counts_BT=history.counts_BT + NUM_VIEWS,
        positions_BTN2=torch.cat([history.positions_BTN2, points_BTN2], dim=2),
        grasps_BTN2=torch.cat([history.grasps_BTN2, points_BTN2], dim=2),
    )


def _reordered(history: HistoryBatch, order_BTN: torch.Tensor) -> HistoryBatch:
    order_BTVN = order_BTN[:, :, None].expand_as(history.crops_BTVN)
    return replace(
        history,
        crops_BTVN=history.crops_BTVN.gather(3, order_BTVN),
        boxes_BTVN4=history.boxes_BTVN4.gather(3, order_BTVN[..., None].expand_as(history.boxes_BTVN4)),
        masks_BTVN=history.masks_BTVN.gather(3, order_BTVN),
        positions_BTN2=history.positions_BTN2.gather(
            2, order_BTN[..., None].expand_as(history.positions_BTN2)
        ),
        grasps_BTN2=history.grasps_BTN2.gather(2, order_BTN[..., None].expand_as(history.grasps_BTN2)),
    )


def _moved(slot_BT: torch.Tensor, place_BTN: torch.Tensor) -> torch.Tensor:
    new_BT = place_BTN.gather(2, slot_BT.clamp(min=0)[..., None]).squeeze(2)
    return torch.where(slot_BT >= 0, new_BT, slot_BT)
