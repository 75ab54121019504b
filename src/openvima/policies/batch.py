"""Network inputs: padded batches of prompts, observations and targets.

Images (crops of objects, or whole frames) are given by their index in a stack, so that each is encoded once.
Index 0 is a blank image, for hidden objects.

Shape suffixes: B batch, T steps, L prompt positions, S objects in all prompts, V views, N objects of an
observation.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch

from openvima.perception.kernels import CROP_SIZE
from openvima.policies.nn.actions import ActionTargets
from openvima.policies.nn.tensor_record import TensorRecord


@runtime_checkable
class StoredImages(Protocol):
    """Images of several demonstrations in files, which can be read straight into a stack."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of an image."""
        ...

    def read_first(self, counts: Sequence[int], starts: Sequence[int], stack: np.ndarray) -> None:
        """Copy the first images of demonstrations.

        Args:
            counts: How many of each demonstration.
            starts: Their places in the stack.
            stack: Where to, (K, 3, height, width), uint8, contiguous.
        """

    def read(self, number: int) -> np.ndarray:
        """Return all images of one demonstration."""
        ...


WORD = -1  # object index at a position that holds a word


@dataclass(frozen=True, slots=True, eq=False)
class PromptBatch(TensorRecord):
    """Padded prompts; image tokens are numbered across the batch.

    Args:
        word_ids_BL: Word ids.
        object_index_BL: Image token at a position, in the order of all first tokens, all second tokens, and
            so on; `WORD` for a word.
        mask_BL: False for padding, and for tokens of objects hidden in their view.
        names_texture_BL: Whether a word is one of texture names, such as "blue".
        crop_index_VS: Index of each object's image in the stack.
        boxes_VS4: Boxes in pixels.
        masks_VS: Whether the object is visible in the view.
        positions_S2: Table points under the boxes, metres.
        image_index_S: Which image of its prompt contains the object, counted from 0 in reading order.
        in_scene_S: Whether that image is a scene, where the object has a position on the table.
    """

    word_ids_BL: torch.Tensor
    object_index_BL: torch.Tensor
    mask_BL: torch.Tensor
    names_texture_BL: torch.Tensor
    crop_index_VS: torch.Tensor
    boxes_VS4: torch.Tensor
    masks_VS: torch.Tensor
    positions_S2: torch.Tensor
    image_index_S: torch.Tensor
    in_scene_S: torch.Tensor


@dataclass(frozen=True, slots=True, eq=False)
class HistoryBatch(TensorRecord):
    """Observations of a batch of episodes, padded to equal numbers of steps and objects.

    Args:
        crop_index_BTVN: Index of each object's image in the stack.
        boxes_BTVN4: Boxes in pixels.
        masks_BTVN: Whether the object is visible in the view.
        num_slots_BT: Number of objects of the step, padding of the batch not counted.
        positions_BTN2: Table points under the boxes, metres.
        grasps_BTN2: Table points under the most interior pixels, metres.
        end_effector_BT: 0 suction cup, 1 spatula.
        steps_BT: False for padding.
    """

    crop_index_BTVN: torch.Tensor
    boxes_BTVN4: torch.Tensor
    masks_BTVN: torch.Tensor
    num_slots_BT: torch.Tensor
    positions_BTN2: torch.Tensor
    grasps_BTN2: torch.Tensor
    end_effector_BT: torch.Tensor
    steps_BT: torch.Tensor


@dataclass(frozen=True, slots=True, eq=False)
class FalsePositiveBatch:
    """One false detection per step and view, for augmentation; all 0 with frames.

    Args:
        crop_index: Indices of the crops, shape (B, T, 2).
        boxes: Boxes in pixels, shape (B, T, 2, 4).
        points: Table points under their centres, shape (B, T, 2, 2), metres.
    """

    crop_index: np.ndarray
    boxes: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Batch(TensorRecord):
    """Several demonstrations, padded.

    Args:
        prompts: Their prompts.
        history: Their observations.
        targets: Their actions.
        false_positives: A false detection for each step and view.
        images: The image stack, shape (K, 3, height, width), uint8; None if one stack holds the images of the
            whole dataset.
    """

    prompts: PromptBatch
    history: HistoryBatch
    targets: ActionTargets
    false_positives: FalsePositiveBatch
    images: torch.Tensor | None = None

    def with_images(self, images: Iterable[np.ndarray], counts: np.ndarray) -> "Batch":
        """Add the images in use, each once after a blank one, and renumber them.

        Args:
            images: Images of each demonstration, (K, 3, height, width), uint8, as they are numbered now.
            counts: Number of them, shape (B,), integers.
        """
        prompt_index, history_index = self.prompts.crop_index_VS, self.history.crop_index_BTVN
        is_used = np.zeros(1 + counts.sum(), np.bool_)
        is_used[0] = is_used[prompt_index.numpy()] = is_used[history_index.numpy()] = True
        numbers = np.cumsum(is_used) - 1
        ends = np.cumsum(counts)
        starts = ends - counts
        first, last = numbers[starts], numbers[ends]  # of the new numbers, the first excluded
        # Those in use come first, unless augmentation left some out: then a copy of contiguous bytes will do.
        is_prefix = numbers[starts + last - first] == last
        if isinstance(images, StoredImages):
            stack = _empty_stack(numbers[-1] + 1, images.shape)
            stack[0] = 0
            images.read_first(np.where(is_prefix, last - first, 0).tolist(), (first + 1).tolist(), stack)
            for b in np.flatnonzero(~is_prefix).tolist():
                used = is_used[starts[b] + 1 : ends[b] + 1]
                stack[first[b] + 1 : last[b] + 1] = images.read(b)[used]
            return self._renumbered(numbers, stack)
        columns = (starts, ends, first, last, is_prefix)
        stack = np.zeros((0, 0, 0, 0), np.uint8)
        for each, (start, end, before, after, prefix) in zip(
            images, zip(*(column.tolist() for column in columns), strict=True), strict=True
        ):
            if not stack.size:
                stack = _empty_stack(numbers[-1] + 1, each.shape[1:])
                stack[0] = 0
            used = each[: after - before] if prefix else each[is_used[start + 1 : end + 1]]
            stack[before + 1 : after + 1] = used
        return self._renumbered(numbers, stack)

    def _renumbered(self, numbers: np.ndarray, stack: np.ndarray) -> "Batch":
        """Return the batch with an image stack; `numbers` are the new numbers of all images."""
        prompts, history = self.prompts, self.history
        return replace(
            self,
            prompts=replace(prompts, crop_index_VS=torch.from_numpy(numbers[prompts.crop_index_VS.numpy()])),
            history=replace(
                history, crop_index_BTVN=torch.from_numpy(numbers[history.crop_index_BTVN.numpy()])
            ),
            images=torch.from_numpy(stack),
        )


def _empty_stack(count: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return memory for images, out of one of few sizes: what one batch frees the next one then takes.

    Fresh pages would cost twice as much time as the copy of the images.
    """
    step = 1 << max(0, int(count).bit_length() - 3)
    return np.empty((-(-count // step) * step, *shape), np.uint8)[:count]


@dataclass(frozen=True, slots=True)
class InputLayout:
    """How images are tokenized.

    Args:
        tokens: What a token encodes: an object in both views, an object in one view, or part of a frame.
        image_size: Height and width of a crop or frame.
        tokens_per_image: Number of tokens of both views of a prompt image or observation; 0 if it depends on
            their objects.
    """

    tokens: Literal["objects", "views", "frames"]
    image_size: tuple[int, int] = (CROP_SIZE, CROP_SIZE)
    tokens_per_image: int = 0
