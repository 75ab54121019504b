"""Demonstrations in memory, as what a policy sees and is to do, and batches of them.

Shape suffixes: B batch, T steps, N objects in view, V views, C components of an action.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from openvima.data.records import Demonstration
from openvima.errors import DatasetError
from openvima.perception.objects import ObjectViews, crop_box
from openvima.policies.heads.base import ACTION_PARTS, ACTION_WIDTH, ActionTargets
from openvima.policies.inputs import (
    HistoryBatch,
    ImageStack,
    PromptBatch,
    PromptInput,
    Reader,
    StepInput,
    batch_histories,
    batch_prompts,
)
from openvima.render.camera import CAMERAS, VIEWS, unproject
from openvima.scene import Action
from openvima.training.schedule import step_seed


@dataclass(frozen=True, slots=True, eq=False)
class Spurious:
    """False detections: for each step one rectangle of each view that shows no object in particular.

    Policies that see whole frames have no detections, true or false; all is 0 for them.

    Args:
        crops: Numbers of the crops, shape (T, 2).
        boxes: Boxes in pixels, shape (T, 2, 4).
        points: Table points under their centres, shape (T, 2, 2), metres.
    """

    crops: np.ndarray
    boxes: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One demonstration, ready for batching.

    Args:
        task: Name of the task.
        seed: Its episode's number.
        prompt: What the robot was told.
        prompt_crops: Numbers of the crops of the prompt's objects, shape (2, objects).
        steps: What it saw before each action.
        step_crops: For each step the numbers of its objects' crops, shape (2, objects).
        actions: What it did, shape (T, 12), metres and quaternions.
        pick_slots: Slot of the picked object at each step; -1 where it is not in view.
        place_slots: Slot of the object relative to which it was placed; -1 where there is none.
        spurious: What a false detection might show at each step.
    """

    task: str
    seed: int
    prompt: PromptInput
    prompt_crops: np.ndarray
    steps: tuple[StepInput, ...]
    step_crops: tuple[np.ndarray, ...]
    actions: np.ndarray
    pick_slots: np.ndarray
    place_slots: np.ndarray
    spurious: Spurious


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Several demonstrations, padded.

    Args:
        prompts: What the robot was told.
        history: What it saw.
        targets: What it did.
        spurious: A false detection for each step and view, shapes (B, T, 2, …).
    """

    prompts: PromptBatch
    history: HistoryBatch
    targets: ActionTargets
    spurious: Spurious


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """All demonstrations of a run.

    Args:
        training: Those to learn from.
        validation: Those that choose the best checkpoint.
        images: All crops or frames, shape (K, 3, height, width), uint8. Number 0 is black: that is what slots
            show that hold no visible object.
    """

    training: tuple[Example, ...]
    validation: tuple[Example, ...]
    images: torch.Tensor


def read_examples(
    demonstrations: Iterable[Demonstration], reader: Reader, *, validation_share: float, seed: int
) -> Examples:
    """Turn demonstrations into examples.

    Whether one is for validation follows from its task and seed, so that it stays there when data are added.

    Args:
        demonstrations: The demonstrations.
        reader: How the network sees prompts and observations.
        validation_share: Share of the demonstrations to keep for validation.
        seed: Seed of the run; false detections are drawn with it.

    Raises:
        DatasetError: There is none to learn from.
        PromptError: A prompt has a word that the vocabulary lacks.
    """
    stack = ImageStack(reader.image_size)
    stack.add(np.zeros((3, *reader.image_size), np.uint8))
    rng = np.random.default_rng(step_seed(seed, "spurious", 0))
    parts: tuple[list[Example], list[Example]] = ([], [])
    for demonstration in demonstrations:
        example = _read_example(demonstration, reader, stack, rng)
        parts[_is_held_out(example, validation_share)].append(example)
    if not parts[0]:
        raise DatasetError(
            "there is no demonstration to learn from; generate some, or lower validation_share."
        )
    return Examples(tuple(parts[0]), tuple(parts[1]), torch.from_numpy(stack.stacked()))


def make_batch(examples: Sequence[Example]) -> Batch:
    """Pad demonstrations to equal lengths."""
    prompts = batch_prompts([e.prompt for e in examples], [e.prompt_crops for e in examples])
    history = batch_histories([e.steps for e in examples], [e.step_crops for e in examples])
    shape = history.steps_BT.shape
    actions = np.zeros((*shape, ACTION_WIDTH))
    slots = np.full((2, *shape), -1)
    for b, example in enumerate(examples):
        count = len(example.steps)
        actions[b, :count] = example.actions
        slots[0, b, :count], slots[1, b, :count] = example.pick_slots, example.place_slots
    pick, place = torch.from_numpy(slots)
    targets = ActionTargets(torch.from_numpy(actions).float(), pick, place, history.steps_BT)
    return Batch(prompts, history, targets, _batch_spurious(examples, shape[1]))


def rows_of_step(num_examples: int, *, batch: int, step: int, seed: int) -> np.ndarray:
    """Which examples a step takes: every epoch is a fresh permutation, and epochs follow without a seam.

    Returns:
        Shape (batch,), int64; a function of the arguments alone, so that a resumed run goes on where it was.
    """
    places = np.arange(step * batch, (step + 1) * batch)
    rows = np.empty(batch, np.int64)
    for epoch in np.unique(places // num_examples):
        rng = np.random.default_rng(step_seed(seed, "order", int(epoch)))
        here = places // num_examples == epoch
        rows[here] = rng.permutation(num_examples)[places[here] % num_examples]
    return rows


def groups_of_equal_length(examples: Sequence[Example]) -> list[list[Example]]:
    """Sort examples into those of one step, of two or three, and longer ones, so that little is padded."""
    groups: dict[int, list[Example]] = {}
    for example in examples:
        groups.setdefault(min(2, len(example.steps) // 2), []).append(example)
    return [groups[key] for key in sorted(groups)]


def _read_example(
    demo: Demonstration, reader: Reader, stack: ImageStack, rng: np.random.Generator
) -> Example:
    prompt, episode = reader.read_prompt(demo.prompt), reader.begin_episode()
    observations = [demo.observation(t) for t in range(demo.num_steps)]
    steps = tuple(episode.read_step(observation) for observation in observations)
    return Example(
        task=demo.task,
        seed=demo.seed,
        prompt=prompt,
        prompt_crops=_add_visible(prompt.objects, stack),
        steps=steps,
        step_crops=tuple(_add_visible(step.objects, stack) for step in steps),
        actions=np.array([_action_vector(action) for action in demo.actions]),
        pick_slots=_slots(demo.pick_ids, steps),
        place_slots=_slots(demo.place_ids, steps),
        spurious=_no_spurious(steps)
        if reader.layout == "frames"
        else _draw_spurious(observations, steps, stack, rng),
    )


def _add_visible(objects: ObjectViews, stack: ImageStack) -> np.ndarray:
    """Add the images of visible objects, and return the numbers of all, shape (2, objects)."""
    numbers = np.zeros(objects.masks.shape, np.int64)
    numbers[objects.masks] = stack.add(objects.crops[objects.masks])
    return numbers


def _draw_spurious(
    observations: Sequence[dict], steps: Sequence[StepInput], stack: ImageStack, rng: np.random.Generator
) -> Spurious:
    """Cut a rectangle of the size of a real box out of a random place of every image."""
    crops = np.zeros((len(steps), len(VIEWS)), np.int64)
    boxes = np.zeros((len(steps), len(VIEWS), 4), np.int64)
    points = np.zeros((len(steps), len(VIEWS), 2))
    for t, (observation, step) in enumerate(zip(observations, steps, strict=True)):
        for v, view in enumerate(VIEWS):
            image = observation["rgb"][view]
            real = step.objects.boxes[v][step.objects.masks[v]]
            height, width = real[rng.integers(len(real)), 2:] if len(real) else (16, 16)
            row, column = rng.integers(image.shape[1] - height), rng.integers(image.shape[2] - width)
            crop, boxes[t, v] = crop_box(image, (column, column + width, row, row + height))
            crops[t, v] = stack.add(crop)
            points[t, v] = unproject(boxes[t, v, :2], CAMERAS[view])
    return Spurious(crops, boxes, points)


def _no_spurious(steps: Sequence[StepInput]) -> Spurious:
    shape = (len(steps), len(VIEWS))
    return Spurious(np.zeros(shape, np.int64), np.zeros((*shape, 4), np.int64), np.zeros((*shape, 2)))


def _batch_spurious(examples: Sequence[Example], num_steps: int) -> Spurious:
    def padded(arrays: list[np.ndarray]) -> np.ndarray:
        result = np.zeros((len(arrays), num_steps, *arrays[0].shape[1:]), arrays[0].dtype)
        for b, array in enumerate(arrays):
            result[b, : len(array)] = array
        return result

    drawn = [example.spurious for example in examples]
    return Spurious(
        padded([s.crops for s in drawn]), padded([s.boxes for s in drawn]), padded([s.points for s in drawn])
    )


def _slots(object_ids: Sequence[int], steps: Sequence[StepInput]) -> np.ndarray:
    slots = np.full(len(steps), -1)
    for t, (object_id, step) in enumerate(zip(object_ids, steps, strict=True)):
        found = np.flatnonzero(step.objects.ids == object_id)
        if object_id >= 0 and len(found):  # negative ids name nothing
            slots[t] = found[0]
    return slots


def _action_vector(action: Action) -> np.ndarray:
    return np.concatenate([np.asarray(getattr(action, key)) for key in ACTION_PARTS])


def _is_held_out(example: Example, share: float) -> bool:
    digest = hashlib.blake2b(f"{example.task}/{example.seed}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") < share * 2**64
