"""What a policy considered when it decided: probabilities, and attention to the prompt. Needs no torch."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from openvima.scene.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Point

SAME_PLACE_M = 0.02  # place candidates this near to each other count as one
PLACE_KINDS = ("in view", "first step", "prompt", "grid")  # where place candidates come from


@dataclass(frozen=True, slots=True, eq=False)
class ObjectProbability:
    """An object in view, and how probable it was to be picked.

    Args:
        object_id: Its value in segmentations; -1 if a detector found it.
        boxes: View name to box, (centre x, centre y, height, width) in pixels; only views that show it.
        grasp: Table point where it would be picked, x and y in metres: under its most interior pixel, or for
            policies over bins under the centre of its box.
        probability: Probability of picking it.
    """

    object_id: int
    boxes: Mapping[str, tuple[int, ...]]
    grasp: Point
    probability: float


@dataclass(frozen=True, slots=True)
class PlaceProbability:
    """A place candidate, and how probable it was, given the picked object.

    Args:
        kind: Where it comes from, one of `PLACE_KINDS`: "in view", an object in view; "first step", an object
            where it was at the first step; "prompt", an object where an image of the prompt shows it; "grid",
            a point of the table, that of the most probable bins for policies over bins.
        position: x and y in metres. The policy adds an offset to it.
        probability: Probability of placing there.
    """

    kind: str
    position: Point
    probability: float


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """How a policy came to its last action in one episode.

    Policies that point fill `objects`, `places` and `yaw_…`; policies over bins fill `bins`, and where they
    read positions from objects, `objects` and `places` as well. Probabilities of each distribution sum to 1,
    and so do the weights of each kind of attention.

    Args:
        action: The action, as `act` returned it.
        prompt: The prompt in reading order: words, images as "{name}", and an empty text for its end.
        attention: Kind of attention to weights of these, shape (P,): "pick" and "place" for policies that
            point, "decoder" (mean over the heads of one layer) for policies over bins.
        objects: The objects in view.
        places: The place candidates.
        yaw_rad: Rotations to choose from, counter-clockwise seen from above, −π up to π, shape (R,).
        yaw_probabilities: How probable each was, given object and place, shape (R,).
        bins: Component of the action, such as "pose0_position.x", to the probabilities of its bins. With an
            autoregressive head they are given the components before.
        words: What the policy said, if it has a language model.
    """

    action: Mapping[str, np.ndarray]
    prompt: tuple[str, ...]
    attention: Mapping[str, np.ndarray] = field(repr=False)
    objects: tuple[ObjectProbability, ...] = ()
    places: tuple[PlaceProbability, ...] = field(default=(), repr=False)
    yaw_rad: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    yaw_probabilities: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    bins: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    words: str = ""

    def distinct_places(self) -> list[PlaceProbability]:
        """Join candidates at one place, the most probable first.

        What is in view is called so, also where it stood at the start; else the most probable kind counts.
        """
        joined: list[PlaceProbability] = []
        for each in sorted(self.places, key=lambda each: -each.probability):
            for index, other in enumerate(joined):
                if math.dist(each.position, other.position) < SAME_PLACE_M:
                    total = each.probability + other.probability
                    kind = each.kind if each.kind == "in view" else other.kind
                    joined[index] = PlaceProbability(kind, other.position, total)
                    break
            else:
                joined.append(each)
        return sorted(joined, key=lambda each: -each.probability)

    def heat_map(self, pose: str) -> np.ndarray:
        """Return the probabilities of the positions of one pose, for policies over bins.

        Args:
            pose: "pose0", the pick, or "pose1", the place.

        Returns:
            Shape (bins of x, bins of y), the product of both marginal distributions. Bin k of n decodes to
            low + (high - low) · k / n of the workspace, see `bin_positions`.
        """
        return np.outer(self.bins[f"{pose}_position.x"], self.bins[f"{pose}_position.y"])


def bin_positions(num_bins: int, axis: int) -> np.ndarray:
    """Return what the bins of x (axis 0) or y (axis 1) decode to, shape (num_bins,), metres."""
    low, high = WORKSPACE_LOW[axis], WORKSPACE_HIGH[axis]
    return low + (high - low) * np.arange(num_bins) / num_bins
