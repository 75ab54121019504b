"""What every action head takes and gives.

Shape suffixes: B batch, T steps, N objects in view, M places of the prompt, K objects that are remembered, D
width, A width of appearance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import nn

from openvima.policies.nn.action_encoder import ACTION_PARTS, ACTION_WIDTH
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW

__all__ = [
    "ACTION_PARTS",
    "ACTION_WIDTH",
    "ActionHead",
    "ActionTargets",
    "Choose",
    "HeadInputs",
    "ReadOn",
    "Recollection",
    "Remembered",
    "from_unit_range",
    "likeliest",
    "masked_mean",
    "to_unit_range",
]

# Scores (B, ..., classes) to indices (B, ...): how a head chooses between its classes.
Choose = Callable[[torch.Tensor], torch.Tensor]
# Number of a component and its bins (B, T) to what the trunk gives after reading them, (B, T, D).
ReadOn = Callable[[int, torch.Tensor], torch.Tensor]

_LOW = (*WORKSPACE_LOW, -1.0, -1.0, -1.0, -1.0)
_HIGH = (*WORKSPACE_HIGH, 1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Remembered:
    """Objects that are not in view now, each where it once was.

    Args:
        tokens_BKD: What is known of them.
        masks_BK: Which of them exist and have a place on the table.
        appearance_BKA: Their appearance.
        positions_BK2: Table points under their boxes, metres; in float32 at least.
        numbers_BK: Which picture of the table shows each, counted from 0 in reading order.
        turns_BKR: Chances of the turns that each has made since an earlier image, counterclockwise, if they
            are estimated.
    """

    tokens_BKD: torch.Tensor
    masks_BK: torch.Tensor
    appearance_BKA: torch.Tensor
    positions_BK2: torch.Tensor
    numbers_BK: torch.Tensor
    turns_BKR: torch.Tensor | None = None

    def select(self, rows: Sequence[int]) -> "Remembered":
        """Return those of some rows of the batch."""
        index = torch.as_tensor(rows, dtype=torch.int64, device=self.masks_BK.device)
        return Remembered(
            self.tokens_BKD[index],
            self.masks_BK[index],
            self.appearance_BKA[index],
            self.positions_BK2[index],
            self.numbers_BK[index],
            None if self.turns_BKR is None else self.turns_BKR[index],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Recollection:
    """What a head may copy places from.

    Args:
        first: Objects that were in view at the first step of the episode.
        scenes: Objects that the prompt's images show.
        steps_T: Numbers of the steps, counted from 0.
        free: Points of the table that stand for places at which nothing is or was; a head may add its own.
    """

    first: Remembered
    scenes: Remembered
    steps_T: torch.Tensor
    free: Remembered | None = None

    @property
    def parts(self) -> tuple[Remembered, ...]:
        """All of it, in this order."""
        return (self.first, self.scenes) if self.free is None else (self.first, self.scenes, self.free)


@dataclass(frozen=True, slots=True, eq=False)
class HeadInputs:
    """What the decoder and the object encoder know at each step.

    Args:
        query_BTD: Output of the decoder at the action query.
        objects_BTND: Output of the decoder at the objects in view.
        masks_BTN: Which of these exist.
        appearance_BTNA: Appearance of the objects in view.
        positions_BTN2: Table points under the objects' boxes, metres; in float32 at least.
        grasps_BTN2: Table points under the objects' most interior pixels, metres; in float32 at least.
        lifts_BT: Whether the tool lifts what it picks, which then moves rigidly with it; else it pushes.
        prompt_BMD: Encoded prompt, one row for each place.
        prompt_masks_BM: Which of these places are objects, or stand for one.
        prompt_appearance_BMA: Appearance of the prompt's objects.
        components_BTCD: Output of the decoder from which each component of the step's action is told, given
            those before it. Only with a token for each component, and where whole histories are read.
        recollection: What was seen elsewhere and before. Only with a head that copies places.
        previous_BTC: The action before each step, metres and quaternions; zero where there was none. Not with
            a token for each component.
        word_looks_BMA: How what each word of the prompt describes looks. Only with a head that copies places.
        prompt_exists_BM: Which places of the prompt exist.
    """

    query_BTD: torch.Tensor
    objects_BTND: torch.Tensor
    masks_BTN: torch.Tensor
    appearance_BTNA: torch.Tensor
    positions_BTN2: torch.Tensor
    grasps_BTN2: torch.Tensor
    lifts_BT: torch.Tensor
    prompt_BMD: torch.Tensor
    prompt_masks_BM: torch.Tensor
    prompt_appearance_BMA: torch.Tensor
    components_BTCD: torch.Tensor | None = None
    recollection: Recollection | None = None
    previous_BTC: torch.Tensor | None = None
    word_looks_BMA: torch.Tensor | None = None
    prompt_exists_BM: torch.Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ActionTargets:
    """What the demonstrator did.

    Args:
        actions_BTC: Actions in metres and quaternions, in the order of `ACTION_PARTS`.
        pick_BT: Slot of the picked object in view; -1 where it is not in view.
        place_BT: Slot of the object relative to which it was placed; -1 where there is none.
        steps_BT: Which steps exist.
    """

    actions_BTC: torch.Tensor
    pick_BT: torch.Tensor
    place_BT: torch.Tensor
    steps_BT: torch.Tensor

    def to(self, device: torch.device | str) -> "ActionTargets":
        """Return the targets on another device."""
        tensors = (self.actions_BTC, self.pick_BT, self.place_BT, self.steps_BT)
        return ActionTargets(*(tensor.to(device) for tensor in tensors))


def likeliest(scores: torch.Tensor) -> torch.Tensor:
    """Choose the class of the highest score, the lowest one among equals."""
    return scores.argmax(-1)


class ActionHead(nn.Module):
    """Base of the heads: a loss for training, a decision for acting.

    Attributes:
        score: The metric that chooses the best checkpoint, a share of 1.
    """

    score = "accuracy"

    def loss(
        self, inputs: HeadInputs, targets: ActionTargets
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Return the mean loss over existing steps, and metrics by name."""
        raise NotImplementedError

    def decide(
        self, inputs: HeadInputs, choose: Choose = likeliest, read_on: ReadOn | None = None
    ) -> torch.Tensor:
        """Return an action for every step, shape (B, T, 12), metres and quaternions, within bounds.

        Args:
            inputs: What is known.
            choose: How to choose between classes.
            read_on: Has the trunk read a component that was chosen; for heads that choose one after the
                other.
        """
        raise NotImplementedError

    def as_history(self, unit_actions: torch.Tensor) -> torch.Tensor:
        """Return actions in unit range as the head would have expressed them, for the history."""
        return unit_actions


def to_unit_range(actions: torch.Tensor) -> torch.Tensor:
    """Map actions (..., 12) from metres and quaternion components to 0 … 1."""
    low, high = _bounds(actions.dtype, actions.device)
    return (actions - low) / (high - low)


def from_unit_range(values: torch.Tensor) -> torch.Tensor:
    """Undo `to_unit_range`; values outside 0 … 1 are clipped to the bounds."""
    low, high = _bounds(values.dtype, values.device)
    return torch.minimum(torch.maximum(low + values * (high - low), low), high)


def masked_mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Mean of the values where the mask is true; 0 where it is true nowhere."""
    weights = mask.to(values.dtype)
    return (values * weights).sum() / weights.sum().clamp(min=1)


@cache
def _bounds(dtype: torch.dtype, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    with torch.inference_mode(False):  # so that those first used in acting serve for training, too
        low = torch.tensor(_LOW + _LOW, dtype=dtype, device=device)
        return low, torch.tensor(_HIGH + _HIGH, dtype=dtype, device=device)
