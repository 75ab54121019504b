"""Single images with the objects that they show, out of demonstrations."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from openvima.data.reader import Dataset
from openvima.data.schema import VIEWS
from openvima.errors import DatasetError
from openvima.perception.objects import MIN_PIXELS
from openvima.render import channels_first
from openvima.scene import BACKGROUND_ID, FIRST_OBJECT_ID

_NUM_IDS = 256


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """An image of H × W pixels, and the objects that show at least two pixels in it.

    Args:
        rgb: Shape (3, H, W), uint8.
        boxes: Left, upper, right and lower edge in pixels, shape (N, 4), float32; pixel 0 is from 0 to 1.
        masks: Which pixels show each object, shape (N, H, W), bool.
    """

    rgb: np.ndarray
    boxes: np.ndarray
    masks: np.ndarray


def frame_of(rgb: np.ndarray, segm: np.ndarray, ids: Sequence[int] | np.ndarray) -> Frame:
    """Find the objects of an image by its segmentation.

    Args:
        rgb: Shape (3, H, W), uint8.
        segm: Object ids, shape (H, W), uint8.
        ids: Which of them are objects.
    """
    shown = np.bincount(segm.ravel(), minlength=_NUM_IDS) >= MIN_PIXELS
    ids = np.array([object_id for object_id in ids if shown[object_id]], np.int64)
    masks = segm == ids[:, None, None]
    boxes = np.zeros((len(ids), 4), np.float32)
    for number, mask in enumerate(masks):
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        boxes[number] = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    return Frame(rgb, boxes, masks)


class FrameSource:
    """Frames of demonstrations: what the cameras saw, and the images of prompts.

    Args:
        dataset: The demonstrations.
        episodes: Which of them; None takes all.
        prompt_share: How often a moment is drawn from the prompt instead of the episode; an image of the
            prompt looks unlike the table, and is found by the same detector.
    """

    def __init__(
        self, dataset: Dataset, episodes: np.ndarray | None = None, *, prompt_share: float = 0.25
    ) -> None:
        self.dataset = dataset
        self.episodes = np.arange(len(dataset)) if episodes is None else episodes
        self._prompt_share = prompt_share

    def __len__(self) -> int:
        return len(self.episodes)

    def draw(self, number: int, rng: np.random.Generator) -> list[Frame]:
        """Draw one moment of an episode and return its frames, front before top.

        Args:
            number: Of the episode, from 0.
            rng: Decides which moment.
        """
        episode, of_prompt = int(self.episodes[number]), rng.random() < self._prompt_share
        if of_prompt and (frames := self._prompt_frames(episode, rng)):
            return frames
        kinds = [f"{kind}_{view}" for view in VIEWS for kind in ("rgb", "segm")]
        values = self.dataset.read(episode, [*kinds, "end_effector"])
        time = int(rng.integers(len(values["rgb_front"])))
        ids = range(FIRST_OBJECT_ID[values["end_effector"]], BACKGROUND_ID)
        return _both_views(values, time, ids, prefix="")

    def _prompt_frames(self, episode: int, rng: np.random.Generator) -> list[Frame]:
        kinds = [f"prompt_{kind}_{view}" for view in VIEWS for kind in ("rgb", "segm")]
        values = self.dataset.read(episode, [*kinds, "prompt_images"])
        images = values["prompt_images"]
        if not images:
            return []
        number = int(rng.integers(len(images)))
        ids = [shown["id"] for shown in images[number]["objects"]]
        return _both_views(values, number, ids, prefix="prompt_")


def held_out_frames(source: FrameSource, count: int, *, seed: int) -> Iterator[Frame]:
    """Yield frames to score a detector on, of as many episodes as possible.

    Args:
        source: Where they come from.
        count: How many; rounded up to pairs of views.
        seed: Decides which.

    Raises:
        DatasetError: There is no episode.
    """
    if not len(source):
        raise DatasetError(
            "there is no demonstration to look at; give more of them, or keep a larger share aside."
        )
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(source))
    for place in range((count + 1) // 2):
        yield from source.draw(int(order[place % len(order)]), rng)


def _both_views(
    values: Mapping[str, Any], number: int, ids: Sequence[int], *, prefix: str
) -> list[Frame]:  # Any: columns of several types
    return [
        frame_of(
            np.ascontiguousarray(channels_first(values[f"{prefix}rgb_{view}"][number])),
            values[f"{prefix}segm_{view}"][number],
            ids,
        )
        for view in VIEWS
    ]
