"""What the heads of the pointer models read.

Shape suffixes: B batch, T steps, N objects in view, L positions of the prompt, K objects of a set, D width, A
width of appearance, P attributes, X width of all their projections, C components of an action, R bins of
rotations.
"""

from dataclasses import dataclass, replace

import torch

from openvima.policies.nn.tensor_record import TensorRecord
from openvima.policies.pointer.correspondence import ObjectFeatures


@dataclass(frozen=True, slots=True, eq=False)
class ObjectSet(TensorRecord):
    """Objects that were seen before, each at its position then.

    Args:
        tokens_BKD: Their tokens.
        masks_BK: Which of them exist and have a position on the table.
        appearance_BKA: Their appearance.
        positions_BK2: Table points under their boxes, metres; in float32 at least.
        image_index_BK: Index of the image of the table that shows each, from 0 in reading order.
        rotations_BKR: Probabilities of the rotation of each since an earlier image, counter-clockwise; R is 0
            if they are not estimated.
    """

    tokens_BKD: torch.Tensor
    masks_BK: torch.Tensor
    appearance_BKA: torch.Tensor
    positions_BK2: torch.Tensor
    image_index_BK: torch.Tensor
    rotations_BKR: torch.Tensor

    @staticmethod
    def of(tokens_BKD: torch.Tensor, objects: ObjectFeatures, rotations_BKR: torch.Tensor) -> "ObjectSet":
        """Combine tokens with what is known of their objects."""
        return ObjectSet(
            tokens_BKD,
            objects.exists_N & objects.in_scene_N,
            objects.appearance_NA,
            objects.positions_N2,
            objects.image_index_N,
            rotations_BKR,
        )


@dataclass(frozen=True, slots=True, eq=False)
class PointerPrompt(TensorRecord):
    """Encoded prompts; constant within an episode.

    Args:
        tokens_BLD: Encoded words and images, for the decoder.
        masked_BLD: The same, encoded with appearance masked: neither crops nor names of textures, so that
            textures cannot be memorised as role cues.
        mask_BL: Which positions exist.
        object_mask_BL: Which of them are images, or words that refer to one.
        appearance_BLA: Appearance of their objects; zero elsewhere.
        text_appearance_BLA: Appearance that words describe; zero for other words.
        features: Objects of the images, shapes (B, M, ...).
        objects: The same as place candidates.
        selected_BP: Which attributes the prompt asks to compare; None without attributes.
        attributes_BLX: Projections of the objects of images, whose dot products are similarities in the
            selected attributes; zero elsewhere.
        describes_BL: Which words describe appearance; None if none does.
    """

    tokens_BLD: torch.Tensor
    masked_BLD: torch.Tensor
    mask_BL: torch.Tensor
    object_mask_BL: torch.Tensor
    appearance_BLA: torch.Tensor
    text_appearance_BLA: torch.Tensor
    features: ObjectFeatures
    objects: ObjectSet
    selected_BP: torch.Tensor | None = None
    attributes_BLX: torch.Tensor | None = None
    describes_BL: torch.Tensor | None = None

    def filled(self) -> "PointerPrompt":
        """Return the prompts with a mask of the words that describe appearance, if none does."""
        if self.describes_BL is not None:
            return self
        return replace(self, describes_BL=torch.zeros_like(self.mask_BL))


@dataclass(frozen=True, slots=True, eq=False)
class HeadInputs:
    """What is known at each step.

    Args:
        query_BTD: Output of the decoder at the action query.
        objects_BTND: Output of the decoder at the objects in view.
        masks_BTN: Which of these exist.
        appearance_BTNA: Appearance of the objects in view.
        positions_BTN2: Table points under the objects' boxes, metres; in float32 at least.
        grasps_BTN2: Table points under the objects' most interior pixels, metres; in float32 at least.
        has_suction_BT: Whether the end effector is the suction cup, which carries an object rigidly; the
            spatula pushes.
        previous_BTC: The action before each step, metres and quaternions; zero where there was none.
        steps_BT: Indices of the steps, from 0; (1, T) if they are those of all episodes.
        first_step: Objects in view at the first step of the episode.
        prompt: Encoded prompts.
        rotations_BTNR: Probabilities of the rotation that brings each object in view to the heading in which
            the prompt shows it, counter-clockwise; zero for those it does not show; R is 0 if rotations are
            not estimated.
        attributes_BTNX: Projections of the objects in view, as `PointerPrompt.attributes_BLX`; None where no
            prompt selects any.
    """

    query_BTD: torch.Tensor
    objects_BTND: torch.Tensor
    masks_BTN: torch.Tensor
    appearance_BTNA: torch.Tensor
    positions_BTN2: torch.Tensor
    grasps_BTN2: torch.Tensor
    has_suction_BT: torch.Tensor
    previous_BTC: torch.Tensor
    steps_BT: torch.Tensor
    first_step: ObjectSet
    prompt: PointerPrompt
    rotations_BTNR: torch.Tensor
    attributes_BTNX: torch.Tensor | None = None


def at(values_BTNX: torch.Tensor, slot_BT: torch.Tensor) -> torch.Tensor:
    """Take the row of one slot at every step: (B, T, N, X) and (B, T) give (B, T, X)."""
    index = slot_BT[..., None, None].expand(*slot_BT.shape, 1, values_BTNX.shape[-1])
    return values_BTNX.gather(2, index).squeeze(2)


def mask_scores(scores: torch.Tensor, exists: torch.Tensor) -> torch.Tensor:
    """Give what does not exist the most negative finite score."""
    return torch.where(exists, scores, torch.finfo(scores.dtype).min)
