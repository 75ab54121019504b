"""Objects from a detector on RGB images, in place of the simulator's segmentation."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from openvima.errors import PolicyError, ShapeError
from openvima.perception.objects import (
    FRONT,
    MIN_PIXELS,
    TOP,
    ObjectExtractor,
    ObjectViews,
    camera_frames,
    crop_box,
    interior_pixel,
    make_hidden_objects,
    part_of,
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
        limit = np.array([width, height], np.float64)
        inside = (edges[:, :2] < limit).all(axis=1) & (edges[:, 2:] > 0).all(axis=1)
        ordered = (edges[:, 2:] >= edges[:, :2]).all(axis=1)
        wrong = ~(inside & ordered & np.isfinite(edges).all(axis=1))
        if wrong.any():
            raise ShapeError(
                f"box {edges[wrong][0].tolist()} lies outside the image of {width} × {height} pixels, or "
                "ends before it begins."
            )
        first = np.maximum(np.floor(edges[:, :2]), 0)
        last = np.maximum(np.minimum(np.ceil(edges[:, 2:]), limit) - 1, first)
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
    min_score: float = field(default=0.1, kw_only=True)
    prompt_extractor: ObjectExtractor | None = field(default=None, kw_only=True)
    cache_size: int = field(default=0, kw_only=True)
    _cache: dict[bytes, ObjectViews] = field(default_factory=dict, init=False, repr=False)

    def in_observation(self, observation: Mapping) -> ObjectViews:
        """Extract the objects of an observation, from left to right.

        Raises:
            PolicyError: A view is missing.
            ShapeError: An image or a detection has another shape or dtype.
            ShapeError: A detection lies outside the image.
        """
        return self._extract(_Pair.of_observation(observation))

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
        return self._extract(_Pair.of_prompt_image(image))

    def extract_ahead(self, observations: Sequence[Mapping], images: Sequence[PromptImage]) -> None:
        """Detect the objects of new images in batches, which takes less time, if there is a cache for them.

        Args:
            observations: What `in_observation` will be asked for.
            images: What `in_prompt_image` will be asked for.

        Raises:
            PolicyError, ShapeError: As those methods.
        """
        pairs = [_Pair.of_observation(each) for each in observations]
        if self.prompt_extractor is None:
            pairs += [_Pair.of_prompt_image(each) for each in images]
        new = [
            (key, pair) for key, pair in {each.key: each for each in pairs}.items() if key not in self._cache
        ]
        new = new[: self.cache_size]
        for start in range(0, len(new), JOINT_PAIRS):
            keys, chunk = zip(*new[start : start + JOINT_PAIRS], strict=True)
            for key, found in zip(keys, self._detect(chunk), strict=True):
                self._keep(key, found)

    def _extract(self, pair: "_Pair") -> ObjectViews:
        if not self.cache_size:
            return self._detect([pair])[0]
        found = self._cache.pop(pair.key, None)
        if found is None:
            (found,) = self._detect([pair])
        self._keep(pair.key, found)
        return found

    def _keep(self, key: bytes, found: ObjectViews) -> None:
        self._cache[key] = found  # the latest is last
        if len(self._cache) > self.cache_size:
            del self._cache[next(iter(self._cache))]

    def _detect(self, pairs: Sequence["_Pair"]) -> list[ObjectViews]:
        frames = [pair.frames[view] for pair in pairs for view in VIEWS]
        views = VIEWS * len(pairs)
        if isinstance(self.detector, BatchDetector):
            detected = self.detector.detect_batch(frames)
        else:
            detected = [self.detector.detect(rgb, view) for rgb, view in zip(frames, views, strict=True)]
        singles = [pair.single for pair in pairs for _ in VIEWS]
        crops = [
            _crop_objects(rgb, self._choose(found, rgb, view, single=single), view)
            for rgb, view, found, single in zip(frames, views, detected, singles, strict=True)
        ]
        return [
            _join(front, top, single=pair.single)
            for pair, front, top in zip(pairs, crops[::2], crops[1::2], strict=True)
        ]

    def _choose(self, found: Detections, rgb: np.ndarray, view: View, *, single: bool) -> Detections:
        _check_within(found, rgb.shape[1:], view)
        if single and len(found):
            return found.select(np.array([0 if found.scores is None else found.scores.argmax()]))
        return found if found.scores is None else found.select(found.scores >= self.min_score)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Both views of an observation or a prompt image; `single` if it is of a single object."""

    frames: Mapping[str, np.ndarray]
    single: bool

    @staticmethod
    def of_observation(observation: Mapping) -> "_Pair":
        return _Pair(camera_frames(part_of(observation, "rgb"), "the observation's rgb"), False)

    @staticmethod
    def of_prompt_image(image: PromptImage) -> "_Pair":
        frames = camera_frames(image.rgb, f"the rgb of prompt image {image.name!r}")
        return _Pair(frames, image.kind == "object")

    @property
    def key(self) -> bytes:
        """Digest of the content, which takes half of the time with SHA-256: CPUs have instructions for it."""
        digest = hashlib.sha256(bytes([self.single]))
        for view in VIEWS:
            digest.update(np.ascontiguousarray(self.frames[view]).data)
        return digest.digest()


@dataclass(frozen=True, slots=True, eq=False)
class _ViewDetections:
    """The detections of one view.

    Args:
        crops: Shape (N, 3, 32, 32), uint8.
        boxes: Centre x, centre y, height, width in pixels, shape (N, 4), int64.
        grasps: Column and row, shape (N, 2), int64.
        corners: Table points under the lower left and the lower right corner of the box, shape (N, 2, 2),
            metres. Upper corners depend on the object's height in the front view.
        colours: Histograms of the colours inside the mask or box, shape (N, 64), each with sum 1.
    """

    crops: np.ndarray
    boxes: np.ndarray
    grasps: np.ndarray
    corners: np.ndarray
    colours: np.ndarray


def _crop_objects(rgb: np.ndarray, found: Detections, view: View) -> _ViewDetections:
    blank = make_hidden_objects(len(found))
    crops, boxes, grasps = blank.crops[0], blank.boxes[0], blank.grasps[0]
    colours = np.zeros((len(found), NUM_BINS**3))
    for k, (left, upper, right, lower) in enumerate(found.boxes.tolist()):
        crops[k], boxes[k] = crop_box(rgb, (left, right, upper, lower))
        inside = rgb[:, upper : lower + 1, left : right + 1]
        mask = None if found.masks is None else found.masks[k, upper : lower + 1, left : right + 1]
        if mask is None or not mask.any():
            grasps[k], colours[k] = boxes[k, :2], _histogram(inside.reshape(3, -1))
            continue
        extent = np.array([0, right - left, 0, lower - upper])
        grasps[k] = interior_pixel(np.ascontiguousarray(mask).view(np.uint8), extent, value=1)
        grasps[k] += left, upper
        colours[k] = _histogram(inside[:, mask])
    corners = found.boxes[:, [[0, 3], [2, 3]]]
    return _ViewDetections(crops, boxes, grasps, unproject(corners, CAMERAS[view]), colours)


def _histogram(pixels: np.ndarray) -> np.ndarray:
    """Return which fraction of pixels (3, K), uint8, is in each bin of RGB, shape (64,)."""
    bins = np.ravel_multi_index(tuple(pixels // (256 // NUM_BINS)), (NUM_BINS,) * 3)
    return np.bincount(bins, minlength=NUM_BINS**3) / pixels.shape[1]


def _join(front: _ViewDetections, top: _ViewDetections, *, single: bool) -> ObjectViews:
    """Match the detections of both views, all of them or those of a single object."""
    both = [(0, 0)] if len(front.boxes) and len(top.boxes) else []
    return _merge_views(front, top, both if single else _match_views(front, top)).left_to_right()


def _match_views(front: _ViewDetections, top: _ViewDetections) -> list[tuple[int, int]]:
    """Greedy matching of front and top detections: repeatedly the pair with the lowest cost."""
    gaps = np.abs(front.corners[:, None] - top.corners).max(axis=2)  # (front, top, x and y)
    distances = gaps[..., 1] + DEPTH_WEIGHT * gaps[..., 0]
    colours = np.abs(front.colours[:, None] - top.colours).sum(axis=-1) / 2
    costs = np.where(distances <= MAX_DISTANCE_M, distances + COLOUR_WEIGHT_M * colours, np.inf)
    pairs = []
    while np.isfinite(costs).any():
        row, column = (int(index) for index in np.unravel_index(costs.argmin(), costs.shape))
        pairs.append((row, column))
        costs[row], costs[:, column] = np.inf, np.inf
    return pairs


def _merge_views(front: _ViewDetections, top: _ViewDetections, pairs: list[tuple[int, int]]) -> ObjectViews:
    """Return one row per pair, then one per object detected in a single view."""
    only_front = sorted(set(range(len(front.boxes))) - {row for row, _ in pairs})
    only_top = sorted(set(range(len(top.boxes))) - {row for _, row in pairs})
    hidden = -1
    slots = [*pairs, *((row, hidden) for row in only_front), *((hidden, row) for row in only_top)]
    rows = np.array(slots, np.int64).reshape(-1, 2)
    objects = make_hidden_objects(len(rows))
    for view, detections in ((FRONT, front), (TOP, top)):
        visible = rows[:, view] != hidden
        chosen = rows[visible, view]
        objects.masks[view] = visible
        objects.crops[view, visible] = detections.crops[chosen]
        objects.boxes[view, visible] = detections.boxes[chosen]
        objects.grasps[view, visible] = detections.grasps[chosen]
    return objects


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
