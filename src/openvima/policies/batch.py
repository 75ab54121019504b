"""Network inputs: padded batches of prompts, observations and targets.

Images (crops of objects, or whole frames) are given by their index in a stack, so that each is encoded once.
Index 0 is a blank image, for hidden objects.

Shape suffixes: B batch, T steps, L prompt positions, S objects in all prompts, V views, N objects of an
observation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch

from openvima.policies.nn.actions import ActionTargets
from openvima.policies.nn.layers import TensorRecord

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

    def with_images(self, images: Sequence[np.ndarray]) -> "Batch":
        """Add the images in use, each once after a blank one, and renumber them.

        Args:
            images: Images of each demonstration, (K, 3, height, width), uint8, as they are numbered now.
        """
        in_prompts = self.prompts.crop_index_VS.numpy()
        in_view = self.history.crop_index_BTVN.numpy()
        ends = np.cumsum([0, *map(len, images)])
        is_used = np.zeros(1 + ends[-1], np.bool_)
        is_used[0] = is_used[in_prompts] = is_used[in_view] = True
        numbers = np.cumsum(is_used) - 1
        stack = _empty_stack(numbers[-1] + 1, images[0].shape[1:])
        stack[0] = 0
        for own, start, end in zip(images, ends[:-1].tolist(), ends[1:].tolist(), strict=True):
            first, last = numbers[start] + 1, numbers[end] + 1
            used = is_used[start + 1 : end + 1]
            # Those in use mostly come first: then contiguous bytes are copied, which is faster.
            is_prefix = used[: last - first].all()
            stack[first:last] = own[: last - first] if is_prefix else own[used]
        return replace(
            self,
            prompts=replace(self.prompts, crop_index_VS=torch.from_numpy(numbers[in_prompts])),
            history=replace(self.history, crop_index_BTVN=torch.from_numpy(numbers[in_view])),
            images=torch.from_numpy(stack),
        )


def _empty_stack(count: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return memory for images, out of one of few sizes: what one batch frees the next one then takes.

    Fresh pages would cost twice as much time as the copy of the images.
    """
    step = 1 << max(0, int(count).bit_length() - 3)
    return np.empty((-(-count // step) * step, *shape), np.uint8)[:count]


class InputLayout(NamedTuple):
    """How images are tokenized.

    Args:
        tokens: What a token encodes: "objects", an object in both views; "views", an object in one view (the
            published VIMA); "frames", part of a whole frame.
        tokens_per_image: Number of tokens of both views of an image; 0 if it depends on its objects.
    """

    tokens: Literal["objects", "views", "frames"]
    tokens_per_image: int = 0
