"""Prompts and observations as tensors: sequences, slots, masks.

Numpy records of single prompts and steps come first, batches of them after. Nothing here has weights. Crops
are given by their number in one stack, so that each is encoded once, or taken from a store of encoded ones.

Shape suffixes: B batch, T steps, L prompt places, S objects in all prompts, V views, N objects in view.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from openvima.policies.perception import ObjectViews, observe, observe_prompt_image
from openvima.policies.tokenizer import PADDING_ID, encode_prompt
from openvima.render.camera import VIEWS
from openvima.scene import RenderedPrompt

WORD = -1  # slot of a place that holds a word


@dataclass(frozen=True, slots=True, eq=False)
class PromptInput:
    """One prompt.

    Args:
        words: Word id at each place, shape (L,), int64; padding where an object stands.
        slots: Row of the object at each place, shape (L,), int64; `WORD` where a word stands.
        views: View whose token stands there, shape (L,), int64; 0 where both views share one token.
        mask: Which places count, shape (L,), bool; not those of objects hidden in their view.
        objects: All objects of all images, one row an appearance in the text.
    """

    words: np.ndarray
    slots: np.ndarray
    views: np.ndarray
    mask: np.ndarray
    objects: ObjectViews


@dataclass(frozen=True, slots=True, eq=False)
class PromptBatch:
    """Prompts of a batch; object rows are numbered through the batch.

    Args:
        words_BL: Word ids.
        slots_BL: Object tokens, numbered through all front (or fused) ones, then all top ones; or `WORD`.
        mask_BL: Which places exist.
        crops_VS: Number of each object's crop in the stack of crops.
        boxes_VS4: Boxes in pixels.
        masks_VS: Whether the object is visible in the view.
    """

    words_BL: torch.Tensor
    slots_BL: torch.Tensor
    mask_BL: torch.Tensor
    crops_VS: torch.Tensor
    boxes_VS4: torch.Tensor
    masks_VS: torch.Tensor


@dataclass(frozen=True, slots=True, eq=False)
class StepInput:
    """One observation.

    Args:
        objects: The objects in view.
        positions: Table points under their boxes, shape (N, 2), metres.
        grasps: Table points under their most interior pixels, shape (N, 2), metres.
        end_effector: 0 suction cup, 1 spatula.
    """

    objects: ObjectViews
    positions: np.ndarray
    grasps: np.ndarray
    end_effector: int


@dataclass(frozen=True, slots=True, eq=False)
class HistoryBatch:
    """Observations of a batch of episodes, padded to equal numbers of steps and objects.

    Args:
        crops_BTVN: Number of each object's crop in the stack of crops.
        boxes_BTVN4: Boxes in pixels.
        masks_BTVN: Whether the object is visible in the view.
        positions_BTN2: Table points under the boxes, metres.
        grasps_BTN2: Table points under the most interior pixels, metres.
        end_effector_BT: 0 suction cup, 1 spatula.
        steps_BT: Which steps exist.
    """

    crops_BTVN: torch.Tensor
    boxes_BTVN4: torch.Tensor
    masks_BTVN: torch.Tensor
    positions_BTN2: torch.Tensor
    grasps_BTN2: torch.Tensor
    end_effector_BT: torch.Tensor
    steps_BT: torch.Tensor


class CropStack:
    """Collects crops in the order in which they come; each is known by its number."""

    def __init__(self) -> None:
        self._crops: list[np.ndarray] = []
        self._size = 0

    def add(self, crops: np.ndarray) -> np.ndarray:
        """Append crops of shape (..., 3, 32, 32) and return their numbers, shape (...), int64."""
        shape = crops.shape[:-3]
        flat = crops.reshape(-1, *crops.shape[-3:])
        self._crops.append(flat)
        self._size += len(flat)
        return np.arange(self._size - len(flat), self._size).reshape(shape)

    def stacked(self) -> np.ndarray:
        """Return all crops, shape (K, 3, 32, 32), uint8."""
        return np.concatenate(self._crops) if self._crops else np.zeros((0, 3, 32, 32), np.uint8)


def read_step(observation: Mapping, *, fuse_views: bool) -> StepInput:
    """Turn an observation into objects.

    Args:
        observation: `rgb` and `segm`, each view name to array, and `ee`, the index of the end effector.
        fuse_views: Whether a slot is one object in both views; else each view has its visible ones first.
    """
    objects = observe(observation)
    objects = objects if fuse_views else objects.compacted()
    return StepInput(objects, objects.positions(), objects.grasp_points(), int(observation["ee"]))


def read_prompt(prompt: RenderedPrompt, *, fuse_views: bool) -> PromptInput:
    """Turn a prompt into words and objects.

    Args:
        prompt: Text and images.
        fuse_views: Whether an object of an image takes one place, or one for each view, front before top.

    Raises:
        PromptError: A word is not in the vocabulary, or placeholders and images do not match.
    """
    places: list[tuple[int, int, int, bool]] = []  # word, slot, view, counts
    images: list[ObjectViews] = []
    count = 0
    for part in encode_prompt(prompt):
        if isinstance(part, int):
            places.append((part, WORD, 0, True))
            continue
        objects = observe_prompt_image(part)
        images.append(objects if fuse_views else objects.compacted())
        for view in range(1 if fuse_views else len(VIEWS)):
            visible = images[-1].visible() if fuse_views else images[-1].masks[view]
            places += [(PADDING_ID, count + k, view, bool(visible[k])) for k in range(len(objects))]
        count += len(objects)
    words, slots, views, mask = (np.array(column) for column in zip(*places, strict=True))
    return PromptInput(words, slots, views, mask, _concatenated(images))


def batch_prompts(prompts: Sequence[PromptInput], crops: Sequence[np.ndarray]) -> PromptBatch:
    """Pad prompts to equal length and number their objects through.

    Args:
        prompts: The prompts.
        crops: For each prompt the numbers of its objects' crops, shape (2, objects).
    """
    length = max(len(prompt.words) for prompt in prompts)
    words = np.full((len(prompts), length), PADDING_ID)
    slots = np.full((len(prompts), length), WORD)
    mask = np.zeros((len(prompts), length), np.bool_)
    first, total = 0, sum(len(prompt.objects) for prompt in prompts)
    for row, prompt in enumerate(prompts):
        size = len(prompt.words)
        words[row, :size] = prompt.words
        numbered = prompt.slots + first + prompt.views * total
        slots[row, :size] = np.where(prompt.slots == WORD, WORD, numbered)
        mask[row, :size] = prompt.mask
        first += len(prompt.objects)
    return PromptBatch(
        torch.from_numpy(words),
        torch.from_numpy(slots),
        torch.from_numpy(mask),
        torch.from_numpy(np.concatenate(list(crops), axis=1)),
        torch.from_numpy(np.concatenate([prompt.objects.boxes for prompt in prompts], axis=1)),
        torch.from_numpy(np.concatenate([prompt.objects.masks for prompt in prompts], axis=1)),
    )


def batch_histories(
    histories: Sequence[Sequence[StepInput]], crops: Sequence[Sequence[np.ndarray]]
) -> HistoryBatch:
    """Pad episodes to equal numbers of steps and of objects.

    Args:
        histories: The steps of each episode.
        crops: For each step the numbers of its objects' crops, shape (2, objects).
    """
    batch, steps = len(histories), max(len(history) for history in histories)
    count = max([1, *(len(step.objects) for history in histories for step in history)])
    numbers = np.zeros((batch, steps, 2, count), np.int64)
    boxes = np.zeros((batch, steps, 2, count, 4), np.int64)
    masks = np.zeros((batch, steps, 2, count), np.bool_)
    positions = np.zeros((batch, steps, count, 2), np.float64)
    grasps = np.zeros((batch, steps, count, 2), np.float64)
    end_effector = np.zeros((batch, steps), np.int64)
    exists = np.zeros((batch, steps), np.bool_)
    for b, history in enumerate(histories):
        for t, step in enumerate(history):
            size = len(step.objects)
            numbers[b, t, :, :size] = crops[b][t]
            boxes[b, t, :, :size] = step.objects.boxes
            masks[b, t, :, :size] = step.objects.masks
            positions[b, t, :size] = step.positions
            grasps[b, t, :size] = step.grasps
            end_effector[b, t] = step.end_effector
            exists[b, t] = True
    arrays = (numbers, boxes, masks, positions, grasps, end_effector, exists)
    return HistoryBatch(*(torch.from_numpy(array) for array in arrays))


def _concatenated(images: Sequence[ObjectViews]) -> ObjectViews:
    if not images:
        empty = np.zeros((2, 0), np.int64)
        crops = np.zeros((2, 0, 3, 32, 32), np.uint8)
        boxes = np.zeros((2, 0, 4), np.int64)
        return ObjectViews(empty[0], crops, boxes, empty.astype(np.bool_), np.zeros((2, 0, 2), np.int64))
    return ObjectViews(
        np.concatenate([image.ids for image in images]),
        np.concatenate([image.crops for image in images], axis=1),
        np.concatenate([image.boxes for image in images], axis=1),
        np.concatenate([image.masks for image in images], axis=1),
        np.concatenate([image.grasps for image in images], axis=1),
    )
