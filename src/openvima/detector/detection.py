"""Objects from a detector on RGB images, in place of the simulator's segmentation."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from openvima.errors import PolicyError, ShapeError
from openvima.perception.boxes import match_greedily
from openvima.perception.objects import (
    MIN_PIXELS,
    TOP,
    ObjectExtractor,
    ObjectViews,
    crop_box,
    interior_pixel,
    make_hidden_objects,
    observation_frames,
    prompt_image_frames,
)
from openvima.render.camera import CAMERAS, VIEWS, View, unproject
from openvima.scene import PromptImage

# Distance between the boxes of one object in both views, measured on 9,000 observations of all tasks and
# levels with ground-truth boxes: median below 3 mm, maximum 99 mm. With these constants none of 248
# observations and prompt scenes of L1 to L3, half of them of follow_order and manipulate_old_neighbor, gets a
# wrong match with masks, and one with boxes alone: in stacks the top view shows only the rim of the lower
# object. With mean colours in place of histograms it was 9 of 249, and without colours 43 of 248.
MAX_DISTANCE_M = 0.1
DEPTH_WEIGHT = 0.5  # the front camera is tilted by 45 degrees, so height appears as distance
COLOUR_WEIGHT_M = 0.3  # metres for histograms of colours without overlap
NUM_BINS = 4  # of each colour channel
JOINT_PAIRS = 4  # pairs of images in a batch: 20 % faster than each alone, and larger batches are no faster
_FORMS = (  # field of `Detections`, kinds of its dtype, axes, and both in words
    (
        "boxes",
        "iu",
        2,
        "an array of integers (N, 4): first column, first row, last column, last row. Detections.from_edges "
        "takes real numbers",
    ),
    ("masks", "b", 3, "an array of bool (N, H, W), as many as boxes"),
    ("scores", "iuf", 1, "an array of numbers (N,), as many as boxes"),
)
MATCHING_VERSION = 2  # grows whenever the same detections give other objects


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Detections in one image of H × W pixels.

    Args:
        boxes: First column, first row, last column, last row of each object, shape (N, 4), integers,
            inclusive. See `from_edges` for floating-point boxes.
        masks: Instance masks, shape (N, H, W), bool. None for boxes only.
        scores: Confidence scores, shape (N,). None for 1.

    Raises:
        ShapeError: An array has another shape or dtype.
        ShapeError: A box ends before it begins, or a score is not a finite number.
    """

    boxes: np.ndarray
    masks: np.ndarray | None = None
    scores: np.ndarray | None = None

    def __post_init__(self) -> None:
        boxes, scores = self.boxes, self.scores
        for name, kinds, ndim, form in _FORMS:
            array = getattr(self, name)
            if array is None and name != "boxes":
                continue
            fits = (
                isinstance(array, np.ndarray)
                and array.dtype.kind in kinds
                and array.ndim == ndim
                and len(array) == len(boxes)
                and (name != "boxes" or array.shape[1] == 4)
            )
            if not fits:
                given = f"{getattr(array, 'dtype', type(array).__name__)} {getattr(array, 'shape', '')}"
                raise ShapeError(f"{name} are {given}; they must be {form}.")
        if scores is not None and not np.isfinite(scores).all():
            raise ShapeError(f"scores are {scores.tolist()}; they must be finite.")
        wrong = np.flatnonzero((boxes[:, 2:] < boxes[:, :2]).any(axis=1))
        if len(wrong):
            raise ShapeError(
                f"box {wrong[0]} is {boxes[wrong[0]].tolist()}; its last column and row must not come before "
                "its first."
            )

    def __len__(self) -> int:
        return len(self.boxes)

    def select(self, rows: np.ndarray) -> "Detections":
        """Index the detections by indices or a boolean mask."""
        masks = None if self.masks is None else self.masks[rows]
        scores = None if self.scores is None else self.scores[rows]
        return Detections(self.boxes[rows], masks, scores)

    @staticmethod
    def from_edges(
        edges: np.ndarray,
        masks: np.ndarray | None = None,
        scores: np.ndarray | None = None,
        *,
        height: int = 128,
        width: int = 256,
    ) -> "Detections":
        """Convert floating-point boxes, as most detectors return them.

        Args:
            edges: Left, upper, right and lower edge of each box, shape (N, 4), in pixels; pixel 0 reaches
                from 0 to 1. A box includes every pixel that it touches and is clipped to the image.
            masks: As in `Detections`.
            scores: As in `Detections`.
            height: Pixels of the image.
            width: Pixels of the image.

        Raises:
            ShapeError: `edges` is not of shape (N, 4).
            ShapeError: An edge is not a finite number, or a box lies outside the image or ends before
                it begins.
        """
        edges = np.asarray(edges, np.float64)
        if edges.ndim != 2 or edges.shape[1] != 4:
            raise ShapeError(f"edges have shape {edges.shape}; it must be (N, 4): left, upper, right, lower.")
        low, high, limit = edges[:, :2], edges[:, 2:], np.array([width, height], np.float64)
        fits = np.isfinite(edges).all(axis=1) & ((low < limit) & (high > 0) & (high >= low)).all(axis=1)
        if not fits.all():
            raise ShapeError(
                f"box {edges[~fits][0].tolist()} lies outside the image of {width} × {height} pixels, or "
                "ends before it begins."
            )
        first = np.maximum(np.floor(low), 0)
        last = np.maximum(np.minimum(np.ceil(high), limit) - 1, first)
        return Detections(np.concatenate([first, last], axis=1).astype(np.int64), masks, scores)

    @staticmethod
    def from_masks(masks: np.ndarray, scores: np.ndarray | None = None) -> "Detections":
        """Compute boxes from masks; masks of fewer than two pixels are dropped.

        Args:
            masks: Instance masks, shape (N, H, W), bool.
            scores: As in `Detections`.

        Raises:
            ShapeError: An array has another shape or dtype.
        """
        found = Detections(np.zeros((len(masks), 4), np.int64), masks, scores)
        large = np.count_nonzero(masks, axis=(1, 2)) >= MIN_PIXELS
        for number in np.flatnonzero(large):
            rows, columns = (np.flatnonzero(masks[number].any(axis=axis)) for axis in (1, 0))
            found.boxes[number] = columns[0], rows[0], columns[-1], rows[-1]
        return found.select(large)


class Detector(Protocol):
    """Detects objects in one image. Arm, end effector and table are not objects."""

    def detect(self, rgb: np.ndarray, view: str) -> Detections:
        """Detect objects in an image of shape (3, 128, 256), uint8, of the view "front" or "top"."""
        ...


@runtime_checkable
class BatchDetector(Detector, Protocol):
    """Detects objects in several images at once."""

    def detect_batch(self, frames: Sequence[np.ndarray]) -> Sequence[Detections]:
        """Detect objects in pairs of a front view and a top view, as `detect` does."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class DetectedObjects:
    """An `ObjectExtractor` that uses a detector instead of the segmentation.

    The boxes of the two views are matched by table position and colour; an unmatched box is an object hidden
    in the other view. All ids are -1.

    Args:
        detector: The detector; a `BatchDetector` gets both views at once.
        min_score: Detections with a lower score are dropped. The default is low, since a missed object
            costs a policy more than a false one: docs/detector.md has measurements.
        prompt_extractor: Extractor of prompt images, for detectors that are not trained on them;
            `GROUND_TRUTH`, for example.
        cache_size: Pairs of images whose objects are kept for when they come again, such as an object that
            many prompts show. Only for a detector that finds the same in equal images.
    """

    detector: Detector
    _: KW_ONLY
    min_score: float = 0.1
    prompt_extractor: ObjectExtractor | None = None
    cache_size: int = 0
    _cache: dict[bytes, ObjectViews] = field(default_factory=dict, init=False, repr=False)

    def in_observation(self, observation: Mapping) -> ObjectViews:
        """Extract the objects of an observation, from left to right.

        Raises:
            PolicyError: A view is missing.
            ShapeError: An image or a detection has another shape or dtype.
            ShapeError: A detection lies outside the image.
        """
        return self._extract(_Pair(observation_frames(observation), False))

    def in_prompt_image(self, image: PromptImage) -> ObjectViews:
        """Extract the objects of a prompt image, from left to right.

        For an image of a single object, only the detection with the highest score (without scores, the first)
        is kept in each view, even below `min_score`.

        Raises:
            PolicyError: A view is missing.
            ShapeError: An image or a detection has another shape or dtype.
            ShapeError: A detection lies outside the image.
        """
        if self.prompt_extractor is not None:
            return self.prompt_extractor.in_prompt_image(image)
        return self._extract(_Pair(prompt_image_frames(image), image.kind == "object"))

    def extract_ahead(self, observations: Sequence[Mapping], images: Sequence[PromptImage]) -> None:
        """Detect the objects of new images in batches, which takes less time, if there is a cache for them.

        Args:
            observations: What `in_observation` will be asked for.
            images: What `in_prompt_image` will be asked for.

        Raises:
            PolicyError, ShapeError: As those methods.
        """
        pairs = [_Pair(observation_frames(each), False) for each in observations]
        if self.prompt_extractor is None:
            pairs += [_Pair(prompt_image_frames(each), each.kind == "object") for each in images]
        unknown = {key: pair for pair in pairs if (key := pair.key) not in self._cache}
        new = list(unknown.items())[: self.cache_size]
        for start in range(0, len(new), JOINT_PAIRS):
            keys, chunk = zip(*new[start : start + JOINT_PAIRS], strict=True)
            for key, found in zip(keys, self._detect(chunk), strict=True):
                self._keep(key, found)

    def _extract(self, pair: "_Pair") -> ObjectViews:
        key = pair.key
        found = self._cache.pop(key, None)
        if found is None:
            (found,) = self._detect([pair])
        self._keep(key, found)
        return found

    def _keep(self, key: bytes, found: ObjectViews) -> None:
        self._cache[key] = found  # the latest is last
        if len(self._cache) > self.cache_size:
            del self._cache[next(iter(self._cache))]

    def _detect(self, pairs: Sequence["_Pair"]) -> list[ObjectViews]:
        frames = [pair.frames[view] for pair in pairs for view in VIEWS]
        if isinstance(self.detector, BatchDetector):
            detected = self.detector.detect_batch(frames)
        else:
            views = VIEWS * len(pairs)
            detected = [self.detector.detect(rgb, view) for rgb, view in zip(frames, views, strict=True)]
        both = zip(detected[::2], detected[1::2], strict=True)
        return [self._join(pair, found) for pair, found in zip(pairs, both, strict=True)]

    def _join(self, pair: "_Pair", detected: Sequence[Detections]) -> ObjectViews:
        """Match the detections of both views; the two of a single object belong together."""
        front, top = (self._cut_out(pair, view, own) for view, own in zip(VIEWS, detected, strict=True))
        count = len(front.objects)
        costs = np.zeros((count, len(top.objects))) if pair.single else _matching_costs(front, top)
        matches = match_greedily(costs)
        objects = ObjectViews.concatenate([front.objects, top.objects])
        slots, moved = [row for row, _ in matches], [count + column for _, column in matches]
        for array in (objects.masks, objects.crops, objects.boxes, objects.grasps):
            array[TOP, slots] = array[TOP, moved]
        others = set(range(len(objects))) - {*slots, *moved}
        return objects.select(np.array([*slots, *sorted(others)], np.int64)).left_to_right()

    def _cut_out(self, pair: "_Pair", view: View, found: Detections) -> "_Seen":
        rgb, v = pair.frames[view], VIEWS.index(view)
        _check_within(found, rgb.shape[1:], view)
        if pair.single and len(found):
            found = found.select(np.array([0 if found.scores is None else found.scores.argmax()]))
        elif found.scores is not None:
            found = found.select(found.scores >= self.min_score)
        objects, colours = make_hidden_objects(len(found)), np.zeros((len(found), NUM_BINS**3))
        objects.masks[v] = True
        for k, (left, upper, right, lower) in enumerate(found.boxes.tolist()):
            objects.crops[v, k], objects.boxes[v, k] = crop_box(rgb, (left, right, upper, lower))
            inside = rgb[:, upper : lower + 1, left : right + 1]
            mask = None if found.masks is None else found.masks[k, upper : lower + 1, left : right + 1]
            if mask is None or not mask.any():
                objects.grasps[v, k], colours[k] = objects.boxes[v, k, :2], _histogram(inside.reshape(3, -1))
                continue
            objects.grasps[v, k] = np.add(interior_pixel(mask), (left, upper))
            colours[k] = _histogram(inside[:, mask])
        return _Seen(objects, unproject(found.boxes[:, [[0, 3], [2, 3]]], CAMERAS[view]), colours)


class _Pair(NamedTuple):
    """Both views of an observation or a prompt image; `single` if it is of a single object."""

    frames: Mapping[str, np.ndarray]
    single: bool

    @property
    def key(self) -> bytes:
        """Digest of the content, which takes half of the time with SHA-256: CPUs have instructions for it."""
        digest = hashlib.sha256(bytes([self.single]))
        for view in VIEWS:
            digest.update(np.ascontiguousarray(self.frames[view]).data)
        return digest.digest()


class _Seen(NamedTuple):
    """The objects of one view, hidden in the other.

    Args:
        objects: The objects.
        corners: Table points under the lower left and the lower right corner of each box, shape (N, 2, 2),
            metres. Upper corners depend on the object's height in the front view.
        colours: Histograms of the colours inside mask or box, shape (N, 64), each with sum 1.
    """

    objects: ObjectViews
    corners: np.ndarray
    colours: np.ndarray


def _histogram(pixels: np.ndarray) -> np.ndarray:
    """Return which fraction of pixels (3, K), uint8, is in each bin of RGB, shape (64,)."""
    bins = np.ravel_multi_index(tuple(pixels // (256 // NUM_BINS)), (NUM_BINS,) * 3)
    return np.bincount(bins, minlength=NUM_BINS**3) / pixels.shape[1]


def _matching_costs(front: _Seen, top: _Seen) -> np.ndarray:
    """Return the cost of matching each object of the front view with each one of the top view."""
    gaps = np.abs(front.corners[:, None] - top.corners).max(axis=2)  # (front, top, x and y)
    distances = gaps[..., 1] + DEPTH_WEIGHT * gaps[..., 0]
    colours = np.abs(front.colours[:, None] - top.colours).sum(axis=-1) / 2
    return np.where(distances <= MAX_DISTANCE_M, distances + COLOUR_WEIGHT_M * colours, np.inf)


def _check_within(found: Detections, shape: tuple[int, ...], view: View) -> None:
    if not isinstance(found, Detections):
        raise PolicyError(
            f"the detector returned a {type(found).__name__} for view {view!r}; it must return Detections."
        )
    height, width = shape
    if found.masks is not None and found.masks.shape[1:] != (height, width):
        raise ShapeError(
            f"masks of view {view!r} have shape {found.masks.shape}; not (N, {height}, {width})."
        )
    outside = (found.boxes < 0) | (found.boxes >= [width, height, width, height])
    if outside.any():
        number = int(np.flatnonzero(outside.any(axis=1))[0])
        raise ShapeError(
            f"box {number} of view {view!r} is {found.boxes[number].tolist()}; columns must lie in "
            f"0 … {width - 1} and rows in 0 … {height - 1}."
        )
