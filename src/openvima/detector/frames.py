"""Annotated frames from demonstrations, for training and evaluating a detector, and their augmentation."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from openvima.data.reader import Dataset
from openvima.data.rerender import with_random_appearance
from openvima.data.schema import VIEWS
from openvima.detector.detection import Detections
from openvima.errors import DatasetError
from openvima.scene import BACKGROUND_ID, FIRST_OBJECT_ID


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """An image of H × W pixels with its objects of at least two visible pixels.

    Args:
        rgb: Shape (3, H, W), uint8.
        boxes: Left, upper, right, lower in pixels, shape (N, 4), float32; pixel 0 covers 0 to 1.
        masks: Shape (N, H, W), bool.
    """

    rgb: np.ndarray
    boxes: np.ndarray
    masks: np.ndarray


def frame_of(rgb: np.ndarray, segm: np.ndarray, ids: Sequence[int] | np.ndarray) -> Frame:
    """Annotate an image from its segmentation.

    Args:
        rgb: Shape (3, H, W), uint8.
        segm: Object ids, shape (H, W), uint8.
        ids: The ids of objects.
    """
    shown = np.asarray(ids)[np.isin(ids, segm)]
    return frame_of_masks(rgb, segm == shown[:, None, None])


def frame_of_masks(rgb: np.ndarray, masks: np.ndarray) -> Frame:
    """Annotate an image from masks, shape (N, H, W), bool; too small ones are dropped."""
    found = Detections.from_masks(masks)
    assert found.masks is not None  # as given
    return Frame(rgb, (found.boxes + np.array([0, 0, 1, 1])).astype(np.float32), found.masks)


class FrameSampler:
    """Samples frames of demonstrations: observations and prompt images.

    Args:
        dataset: The demonstrations.
        episodes: Indices of the demonstrations to use; None takes all.
        prompt_prob: Probability of sampling a prompt image instead of an observation.
        rerendered_prob: Probability of rendering the demonstration with random shapes and textures.
    """

    def __init__(
        self,
        dataset: Dataset,
        episodes: np.ndarray | None = None,
        *,
        prompt_prob: float = 0.25,
        rerendered_prob: float = 0.0,
    ) -> None:
        self.dataset = dataset
        self.episodes = np.arange(len(dataset)) if episodes is None else episodes
        self._prompt_prob, self._rerendered_prob = prompt_prob, rerendered_prob

    def __len__(self) -> int:
        return len(self.episodes)

    def sample(self, index: int, rng: np.random.Generator) -> list[Frame]:
        """Sample one time step or prompt image and return its frames, front before top.

        Args:
            index: Of the episode, among `episodes`.
            rng: Selects the time step or prompt image.
        """
        episode, from_prompt = int(self.episodes[index]), rng.random() < self._prompt_prob
        demo = self.dataset[episode]
        if self._rerendered_prob and rng.random() < self._rerendered_prob:
            shard = self.dataset.shard(self.dataset.locate(episode)[0])
            demo = with_random_appearance(demo, shard.info, 0)
        if from_prompt and (images := list(demo.prompt.images.values())):
            image = images[int(rng.integers(len(images)))]
            ids = [record.object_id for record in image.objects]
            return [frame_of(image.rgb[view], image.segm[view], ids) for view in VIEWS]
        time = int(rng.integers(demo.num_steps + 1))
        shown = range(FIRST_OBJECT_ID[demo.end_effector], BACKGROUND_ID)
        return [frame_of(demo.rgb[view][time], demo.segm[view][time], shown) for view in VIEWS]


def held_out_frames(sampler: FrameSampler, count: int, *, seed: int) -> Iterator[Frame]:
    """Yield frames to evaluate a detector on, from as many episodes as possible.

    Args:
        sampler: Source of the frames.
        count: Number of frames; rounded up to pairs of views.
        seed: Seed of the sampling.

    Raises:
        DatasetError: There is no episode.
    """
    if not len(sampler):
        raise DatasetError(
            "there are no demonstrations to evaluate on; add some, or hold out a larger fraction."
        )
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(sampler))
    for index in range((count + 1) // 2):
        yield from sampler.sample(int(order[index % len(order)]), rng)


RECOLOUR_PROB = 0.5  # of each object, so that unseen textures are found, too
FLIP_PROB = 0.5  # of each frame
LEAST_VISIBLE = 0.1  # fraction of an object that a pasted one leaves


def augment_frame(frame: Frame, rng: np.random.Generator, *, paste_prob: float = 0.0) -> Frame:
    """Paste an object onto another one, recolour some, and flip the frame at random.

    Args:
        frame: The frame.
        rng: Source of all draws.
        paste_prob: Probability of pasting.
    """
    if paste_prob and len(frame.masks) and rng.random() < paste_prob:
        frame = paste_object(frame, rng)
    rgb = frame.rgb.copy()
    for mask in frame.masks:
        if rng.random() < RECOLOUR_PROB:
            rgb[:, mask] = mix_channels(rgb[:, mask], rng)
    changed = replace(frame, rgb=rgb)
    return flip_horizontally(changed) if rng.random() < FLIP_PROB else changed


def paste_object(frame: Frame, rng: np.random.Generator) -> Frame:
    """Paste a copy of an object onto an object, perhaps onto itself: stacks and full containers are rare.

    Args:
        frame: The frame, with at least one object.
        rng: Selects both objects, the position and whether the copy is mirrored.

    Returns:
        The frame with one more object. It is unchanged if the copy would not fit into the image, or hide an
        object.

    Source: copy-paste augmentation (Ghiasi et al. 2021).
    """
    source, target = rng.integers(len(frame.masks), size=2).tolist()
    first, last = frame.boxes[source].astype(int).reshape(2, 2)  # column and row of what is copied
    low, high = frame.boxes[target].astype(np.float64).reshape(2, 2)
    offset = rng.uniform(-0.3, 0.3, 2) * (high - low)
    start = ((low + high) / 2 + offset - (last - first) / 2).round().astype(int)
    end = start + last - first
    _, height, width = frame.rgb.shape
    if (start < 0).any() or (end > (width, height)).any():
        return frame
    step = -1 if rng.random() < 0.5 else 1
    source_window, window = (
        (slice(low[1], high[1]), slice(low[0], high[0])) for low, high in ((first, last), (start, end))
    )
    shape = frame.masks[source][source_window][:, ::step]
    rgb, pasted = frame.rgb.copy(), np.zeros((1, height, width), bool)
    pasted[0][window] = shape
    rgb[:, pasted[0]] = frame.rgb[:, *source_window][:, :, ::step][:, shape]
    left_over = frame.masks & ~pasted
    if (left_over.sum(axis=(1, 2)) < LEAST_VISIBLE * frame.masks.sum(axis=(1, 2))).any():
        return frame
    return frame_of_masks(rgb, np.concatenate([left_over, pasted]))


def mix_channels(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Mix the channels of pixels (3, K), uint8, by a random matrix and a random shift.

    Brightness is kept or inverted. Distinct colours mostly stay distinct.
    """
    mixing = rng.uniform(-1, 1, (3, 3))
    mixing /= np.abs(mixing).sum(axis=1, keepdims=True)
    centred = pixels.astype(np.float64) / 255 - 0.5
    mixed = 2 * rng.uniform(0.3, 1) * mixing @ centred + rng.uniform(0.15, 0.85, (3, 1))
    return (mixed * 255).round().clip(0, 255).astype(np.uint8)


def flip_horizontally(frame: Frame) -> Frame:
    """Mirror a frame with its boxes and masks."""
    width = frame.rgb.shape[2]
    boxes = frame.boxes.copy()
    boxes[:, [0, 2]] = width - boxes[:, [2, 0]]
    return Frame(frame.rgb[:, :, ::-1].copy(), boxes, frame.masks[:, :, ::-1].copy())
