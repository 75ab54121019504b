"""Inputs of policies: tables of objects, and stacks that store each of their images once."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from openvima.perception.kernels import CROP_SIZE
from openvima.perception.objects import (
    GROUND_TRUTH,
    AheadExtractor,
    ObjectExtractor,
    ObjectViews,
    part_of,
    whole_frames,
)
from openvima.scene import PromptImage, RenderedPrompt
from openvima.scene.prompt import PLACEHOLDER, split_text

FOUND = "found"  # key of an observation's objects where they were found beforehand
InputKind = Literal["objects", "frames"]
KINDS: tuple[InputKind, ...] = get_args(InputKind)
IMAGE_SIZES: dict[InputKind, tuple[int, int]] = {"objects": (CROP_SIZE, CROP_SIZE), "frames": (64, 128)}


class ImageStack:
    """Collects images; equal ones share an index, and index 0 is a blank image for what is hidden.

    Many images are equal: an object that does not move has the same crop at the next step.

    Args:
        kind: Kind of the images, which decides their size.
    """

    def __init__(self, kind: InputKind) -> None:
        self._shape = (3, *IMAGE_SIZES[kind])
        self._images = [np.zeros(self._shape, np.uint8)]
        self._index: dict[bytes, int] = {b"": 0}  # by digest, which is shorter than the image

    def add(self, images: np.ndarray) -> np.ndarray:
        """Append images of shape (..., 3, height, width) and return their indices, shape (...), int64."""
        shape = images.shape[:-3]
        index = [self._add(image) for image in images.reshape(-1, *self._shape)]
        return np.array(index, np.int64).reshape(shape)

    def images(self) -> np.ndarray:
        """Return all images, the blank one first, shape (K, 3, height, width), uint8."""
        return np.stack(self._images)

    def digests(self) -> list[bytes]:
        """Return what identifies the content of each image, in the order of `images`."""
        return list(self._index)

    def _add(self, image: np.ndarray) -> int:
        digest = hashlib.blake2b(image.tobytes(), digest_size=16).digest()
        index = self._index.setdefault(digest, len(self._images))
        if index == len(self._images):
            self._images.append(image.copy())
        return index


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FoundImage(PromptImage):
    """A prompt image whose objects were found beforehand."""

    found: ObjectViews


@dataclass(frozen=True, slots=True, eq=False)
class ObjectTable:
    """Objects of one or several images, one row each. View axis: front, then top.

    Args:
        ids: Segmentation values, shape (N,), integers. With an extractor that knows none, the object's rank
            in its image, from 0.
        crop_index: Index of the object's image in the stack, shape (N, 2), integers; 0 where hidden.
        boxes: Centre x, centre y, height, width in pixels, shape (N, 2, 4), integers; zero where hidden.
        grasps: Column and row of the most interior visible pixel, shape (N, 2, 2), integers; zero where
            hidden.
    """

    ids: np.ndarray
    crop_index: np.ndarray
    boxes: np.ndarray
    grasps: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def masks(self) -> np.ndarray:
        """Whether each object is visible in each view, shape (N, 2), bool."""
        return np.asarray(self.crop_index > 0)

    def select(self, rows: np.ndarray | slice) -> "ObjectTable":
        """Return some rows (indices, booleans or a slice), in that order."""
        return ObjectTable(self.ids[rows], self.crop_index[rows], self.boxes[rows], self.grasps[rows])

    def split(self, counts: np.ndarray) -> list["ObjectTable"]:
        """Divide the rows into consecutive tables of these lengths."""
        ends = np.cumsum(counts)
        return [
            self.select(slice(int(end - count), int(end))) for count, end in zip(counts, ends, strict=True)
        ]

    def with_image_offset(self, offset: int | np.ndarray) -> "ObjectTable":
        """Return the same objects, their images `offset` further down a larger stack."""
        return ObjectTable(self.ids, offset_index(self.crop_index, offset), self.boxes, self.grasps)

    @staticmethod
    def concatenate(tables: Sequence["ObjectTable"]) -> "ObjectTable":
        """Put the rows of several tables into one."""
        if not tables:
            return ObjectTable.from_views(ObjectViews.concatenate([]), ImageStack("objects"))
        names = ("ids", "crop_index", "boxes", "grasps")
        return ObjectTable(*(np.concatenate([getattr(table, name) for table in tables]) for name in names))

    @staticmethod
    def from_views(objects: ObjectViews, stack: ImageStack) -> "ObjectTable":
        """Put the images of the visible objects onto a stack, and name them by their index there."""
        crop_index = np.zeros(objects.masks.shape, np.int32)
        if objects.masks.any():
            crop_index[objects.masks] = stack.add(objects.crops[objects.masks])
        return ObjectTable(
            objects.ids.astype(np.int16),
            np.ascontiguousarray(crop_index.T),
            *(
                np.ascontiguousarray(part.swapaxes(0, 1), np.int16)
                for part in (objects.boxes, objects.grasps)
            ),
        )


@dataclass(frozen=True, slots=True, eq=False)
class PreprocessedPrompt:
    """A prompt of I images.

    Args:
        text: The sentence, with `{name}` placeholders.
        objects: Objects of the images, image after image in the order in which the text first names them.
            With frames each image counts as one object.
        objects_per_image: Number of objects of each image, shape (I,), int16.
        is_scene: Whether the image shows the table (`PromptImage.kind` "scene") or one object on white
            ("object"), shape (I,), bool.
    """

    text: str
    objects: ObjectTable
    objects_per_image: np.ndarray
    is_scene: np.ndarray

    @property
    def image_names(self) -> tuple[str, ...]:
        """The placeholders, in the order of the images."""
        return image_names(self.text)


def preprocess_prompt(
    prompt: RenderedPrompt, kind: InputKind, extractor: ObjectExtractor | None, stack: ImageStack
) -> PreprocessedPrompt:
    """Extract the objects of a prompt's images.

    Args:
        prompt: The prompt.
        kind: "objects" for crops of the objects, "frames" for whole frames at half the size.
        extractor: Finds the objects; None takes the segmentation.
        stack: Where the images go.

    Raises:
        PolicyError: An image lacks a view.
        ShapeError: An image has another shape or dtype.
    """
    images = [prompt.images[name] for name in image_names(prompt.text)]
    found = [_extract_prompt_image(image, kind, extractor) for image in images]
    return PreprocessedPrompt(
        prompt.text,
        ObjectTable.from_views(ObjectViews.concatenate(found), stack),
        np.array([len(objects) for objects in found], np.int16),
        np.array([image.kind == "scene" for image in images], np.bool_),
    )


def extract_observation(
    observation: Mapping,
    kind: InputKind,
    extractor: ObjectExtractor | None = None,
) -> ObjectViews:
    """Extract the objects of an observation, or take both frames whole as one object.

    Args:
        observation: `rgb`, `segm` where the segmentation is used, and `ee`; `FOUND` where the objects were
            found beforehand.
        kind: "objects" or "frames".
        extractor: Finds the objects; None takes the segmentation, in left-to-right order.

    Raises:
        PolicyError: A part or a view is missing, or there is no such end effector.
        ShapeError: An image has another shape or dtype.
    """
    if kind == "frames":
        return whole_frames(part_of(observation, "rgb"))
    if FOUND in observation:
        return observation[FOUND]
    if extractor is None:
        return GROUND_TRUTH.in_observation(observation)
    return _number(extractor.in_observation(observation))


def extract_ahead(
    kind: InputKind,
    extractor: ObjectExtractor | None,
    *,
    observations: Sequence[Mapping] = (),
    prompts: Sequence[RenderedPrompt] = (),
) -> None:
    """Let an extractor find the objects of several observations or prompts together, if it can.

    Args:
        kind: As for `extract_observation`.
        extractor: As for `extract_observation`, which is to be called after this.
        observations: Its arguments.
        prompts: Those of `preprocess_prompt`.
    """
    if kind == "objects" and isinstance(extractor, AheadExtractor):
        images = [prompt.images[name] for prompt in prompts for name in image_names(prompt.text)]
        extractor.extract_ahead(
            [each for each in observations if FOUND not in each],
            [each for each in images if not isinstance(each, FoundImage)],
        )


def offset_index(crop_index: np.ndarray, offset: int | np.ndarray) -> np.ndarray:
    """Add an offset to indices of images, int64; 0 stays 0."""
    moved = crop_index.astype(np.int64)
    return np.add(moved, offset, out=moved, where=moved > 0)


def image_names(text: str) -> tuple[str, ...]:
    """Return the placeholders of a prompt in the order in which the text first names them."""
    return tuple(dict.fromkeys(PLACEHOLDER.findall(text)))


@lru_cache(maxsize=2**16)
def split_prompt(text: str) -> tuple[str | int, ...]:
    """Split a prompt into texts and images, in reading order.

    Returns:
        Texts, and for each placeholder the number of its image in the order of `image_names`.
    """
    return tuple(split_text(text, image_names(text).index))


def _extract_prompt_image(
    image: PromptImage, kind: InputKind, extractor: ObjectExtractor | None
) -> ObjectViews:
    if kind == "frames":
        return whole_frames(image.rgb)
    if isinstance(image, FoundImage):
        return image.found
    if extractor is None:
        return GROUND_TRUTH.in_prompt_image(image)
    return _number(extractor.in_prompt_image(image))


def _number(found: ObjectViews) -> ObjectViews:
    """Number what an extractor found in its own order."""
    return replace(found, ids=np.arange(len(found)))
