"""One demonstration as tokens: what a policy sees of it, and what it is to do."""

import re
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from openvima.data.records import Demonstration
from openvima.data.schema import VIEWS
from openvima.perception.image_stack import ImageStack
from openvima.perception.iou import slots_of_ids
from openvima.perception.kernels import CROP_SIZE
from openvima.perception.objects import (
    GROUND_TRUTH,
    ObjectExtractor,
    ObjectViews,
    crop_box,
    observe,
    whole_frames,
)
from openvima.scene import ACTION_SHAPES, END_EFFECTORS, Action, PromptImage

InputKind = Literal["objects", "frames"]
KINDS: tuple[InputKind, ...] = get_args(InputKind)
IMAGE_SIZES: dict[InputKind, tuple[int, int]] = {"objects": (CROP_SIZE, CROP_SIZE), "frames": (64, 128)}
ACTION_PARTS = tuple(ACTION_SHAPES)

# What stands where in a row of the three tables. Numbers name images, front view then top view, 0 where the
# object is hidden; boxes are centre x, centre y, height, width in pixels; grasps column and row.
ID, NUMBERS, BOXES, GRASPS = 0, slice(1, 3), slice(3, 11), slice(11, 15)  # of an object
PROMPT_WIDTH, OBJECT_WIDTH = 11, 15  # objects of the prompt and of the end have no grasps
COUNT, PICK, PLACE, SPURIOUS_NUMBERS, SPURIOUS_BOXES = 0, 1, 2, slice(3, 5), slice(5, 13)  # of a step
STEP_WIDTH = 13

_PLACEHOLDER = re.compile(r"\{(\w+)\}")
_SMALL_BOX = 16  # pixels, of a false detection where a view shows nothing to take the size from


@dataclass(frozen=True, slots=True, eq=False)
class PreprocessedEpisode:
    """One demonstration of T steps, ready for a policy.

    Ids are those of the segmentation. Where a detector found the objects, which knows none, an id is the
    place of the object in its moment or image, from 0; objects to pick and to place at are named by it, too,
    and are -1 where they were not found.

    Args:
        task: Name of the task.
        seed: Its episode's number.
        text: The prompt, with `{name}` placeholders.
        end_effector: 0 suction cup, 1 spatula.
        prompt_counts: Objects that each prompt image shows, in the order in which the text first names the
            images, shape (I,), int32. With frames each image counts as one object.
        prompt: One row an object of these images: id, numbers of its two images, its two boxes; shape
            (P, 11), int16.
        steps: One row a step: number of objects in view, ids of the objects to pick and to place at, numbers
            and boxes of two false detections; shape (T, 13), int16.
        objects: One row an object in view, step after step, in the extractor's order (left to right): id,
            numbers of its two images, boxes, grasp points; shape (O, 15), int16.
        final: One row an object in view after the last step, like those of the prompt; shape (F, 11), int16.
        actions: What the oracle did, shape (T, 12), float32: positions in metres and quaternions.
        images: All crops or halved frames, shape (K, 3, height, width), uint8; number n is `images[n - 1]`.
    """

    task: str
    seed: int
    text: str
    end_effector: int
    prompt_counts: np.ndarray
    prompt: np.ndarray
    steps: np.ndarray
    objects: np.ndarray
    final: np.ndarray
    actions: np.ndarray
    images: np.ndarray

    @property
    def num_steps(self) -> int:
        """Number of actions, T."""
        return len(self.steps)


def preprocess(
    demo: Demonstration, kind: InputKind, extractor: ObjectExtractor | None = None
) -> PreprocessedEpisode:
    """Cut out what policies see of a demonstration.

    Args:
        demo: The demonstration.
        kind: "objects" for crops of the objects, "frames" for whole frames at half the size.
        extractor: Finds the objects, in the images of the prompt, too; None takes the segmentation.

    Raises:
        PolicyError: A view is missing, or objects have impossible ids.
    """
    stack = ImageStack(IMAGE_SIZES[kind])
    images = [demo.prompt.images[name] for name in image_names(demo.prompt.text)]
    seen = [_see_prompt_image(image, kind, extractor) for image in images]
    prompt = ObjectViews.concatenated(seen)
    observations = [demo.observation(t) for t in range(demo.num_steps)]
    views = [_see(observation, kind, extractor) for observation in observations]
    everything = ObjectViews.concatenated(views)
    prompt_rows = _rows(prompt, stack)
    object_rows = np.concatenate(
        [_rows(everything, stack), everything.grasps.swapaxes(0, 1).reshape(-1, 4)], 1
    )
    steps = np.zeros((demo.num_steps, STEP_WIDTH), np.int16)
    steps[:, COUNT] = [len(objects) for objects in views]
    steps[:, PICK], steps[:, PLACE] = demo.pick_ids, demo.place_ids
    if extractor is not None:
        _name_by_slots(steps, observations, views)
    if kind == "objects":
        # By the content alone, so that the cache does not depend on who makes it and in what order.
        rng = np.random.default_rng([demo.seed, *demo.task.encode()])
        _draw_spurious(steps, observations, views, stack, rng)
    final_rows = _rows(_see(demo.observation(demo.num_steps), kind, extractor), stack)
    return PreprocessedEpisode(
        task=demo.task,
        seed=demo.seed,
        text=demo.prompt.text,
        end_effector=END_EFFECTORS.index(demo.end_effector),
        prompt_counts=np.array([len(objects) for objects in seen], np.int32),
        prompt=prompt_rows.astype(np.int16),
        steps=steps,
        objects=object_rows.astype(np.int16),
        final=final_rows.astype(np.int16),
        actions=np.array([_action_row(action) for action in demo.actions], np.float32).reshape(-1, 12),
        images=stack.stacked(),
    )


def image_names(text: str) -> tuple[str, ...]:
    """Return the placeholders of a prompt in the order in which the text first names them."""
    return tuple(dict.fromkeys(piece for k, piece in enumerate(_PLACEHOLDER.split(text)) if k % 2))


@lru_cache(maxsize=2**16)
def pieces_of(text: str) -> tuple[str | int, ...]:
    """Split a prompt into words and images, in reading order.

    Returns:
        Texts, and for each placeholder the number of its image in the order of `image_names`.
    """
    numbers = {name: number for number, name in enumerate(image_names(text))}
    parts = _PLACEHOLDER.split(text)  # text at even places, names at odd ones
    pieces = [numbers[part] if k % 2 else part.strip() for k, part in enumerate(parts)]
    return tuple(piece for piece in pieces if piece != "")


def _see_prompt_image(image: PromptImage, kind: InputKind, extractor: ObjectExtractor | None) -> ObjectViews:
    if kind == "frames":
        return whole_frames(image.rgb)
    return _numbered(extractor.in_prompt_image(image)) if extractor else GROUND_TRUTH.in_prompt_image(image)


def _see(observation: dict, kind: InputKind, extractor: ObjectExtractor | None) -> ObjectViews:
    if kind == "frames":
        return whole_frames(observation["rgb"])
    return (
        _numbered(extractor.in_observation(observation))
        if extractor
        else GROUND_TRUTH.in_observation(observation)
    )


def _numbered(found: ObjectViews) -> ObjectViews:
    """Number what was found in its own order, which so is that of the ids, too."""
    return replace(found, ids=np.arange(len(found)))


def _name_by_slots(steps: np.ndarray, observations: list[dict], views: list[ObjectViews]) -> None:
    """Name the objects to pick and to place at by their place among those found, -1 where they are not."""
    for step, observation, found in zip(steps, observations, views, strict=True):
        slots = slots_of_ids(found, observe(observation))
        for column in (PICK, PLACE):
            step[column] = slots.get(int(step[column]), -1)


def _rows(objects: ObjectViews, stack: ImageStack) -> np.ndarray:
    """Ids, numbers and boxes, shape (N, 11); images of what is visible go on the stack."""
    numbers = np.zeros(objects.masks.shape, np.int64)
    if objects.masks.any():
        numbers[objects.masks] = 1 + stack.add(objects.crops[objects.masks])
    boxes = objects.boxes.swapaxes(0, 1).reshape(-1, 8)
    return np.concatenate([objects.ids[:, None], numbers.T, boxes], axis=1)


def _draw_spurious(
    steps: np.ndarray,
    observations: list[dict],
    views: list[ObjectViews],
    stack: ImageStack,
    rng: np.random.Generator,
) -> None:
    """Cut a rectangle of the size of a real box out of a random place of every image."""
    boxes = np.zeros((len(steps), len(VIEWS), 4), np.int64)
    for t, (observation, objects) in enumerate(zip(observations, views, strict=True)):
        for v, view in enumerate(VIEWS):
            image = observation["rgb"][view]
            real = objects.boxes[v][objects.masks[v]]
            height, width = real[rng.integers(len(real)), 2:] if len(real) else (_SMALL_BOX, _SMALL_BOX)
            row, column = rng.integers(image.shape[1] - height), rng.integers(image.shape[2] - width)
            crop, boxes[t, v] = crop_box(image, (column, column + width, row, row + height))
            steps[t, SPURIOUS_NUMBERS][v] = 1 + stack.add(crop)
    steps[:, SPURIOUS_BOXES] = boxes.reshape(-1, 8)


def _action_row(action: Action) -> np.ndarray:
    return np.concatenate([np.asarray(getattr(action, part)) for part in ACTION_PARTS])
