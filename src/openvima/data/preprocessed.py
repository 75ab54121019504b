"""One demonstration as a policy takes it: tables of objects, and the actions to learn."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from openvima.data.records import Demonstration, action_arrays
from openvima.data.schema import VIEWS
from openvima.perception.boxes import match_ids_to_slots
from openvima.perception.objects import ObjectExtractor, ObjectViews, crop_box, observe
from openvima.perception.preprocessing import (
    ImageStack,
    InputKind,
    ObjectTable,
    PreprocessedPrompt,
    extract_ahead,
    extract_observation,
    offset_index,
    preprocess_prompt,
)
from openvima.scene import END_EFFECTORS
from openvima.tasks.prompts import image_descriptions

_SMALL_BOX = 16  # pixels, of a false positive where a view shows nothing to take the size from


@dataclass(frozen=True, slots=True, eq=False)
class FalsePositives:
    """One false detection for each step and view: a rectangle that shows no object in particular.

    With frames, which have no detections, all is 0.

    Args:
        crop_index: Indices of the crops, shape (T, 2), integers.
        boxes: Boxes in pixels, shape (T, 2, 4), integers.
    """

    crop_index: np.ndarray
    boxes: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class PreprocessedEpisode:
    """One demonstration of T steps, ready for a policy.

    Args:
        task: Name of the task.
        seed: Its episode's number.
        end_effector: 0 suction cup, 1 spatula.
        prompt: The prompt.
        objects: Visible objects of all observations, step after step, from left to right (or in the
            extractor's order).
        objects_per_step: Number of them, shape (T,), int16.
        pick_ids: Id of the object to pick, shape (T,), int16; -1 where there is none, or an extractor missed
            it.
        place_ids: Id of the object to place at, likewise.
        false_positives: False detections to augment with.
        final: Visible objects after the last step.
        actions: Actions to learn, shape (T, 12), float32: positions in metres and quaternions.
        images: All crops or halved frames but the blank one, shape (K, 3, height, width), uint8; index n is
            `images[n - 1]`.
        descriptions: Texture and name of the objects in object images of the task's prompt, by placeholder;
            see `openvima.tasks.prompts.image_descriptions`.
    """

    task: str
    seed: int
    end_effector: int
    prompt: PreprocessedPrompt
    objects: ObjectTable
    objects_per_step: np.ndarray
    pick_ids: np.ndarray
    place_ids: np.ndarray
    false_positives: FalsePositives
    final: ObjectTable
    actions: np.ndarray
    images: np.ndarray
    descriptions: Mapping[str, str]

    @property
    def num_steps(self) -> int:
        """Number of actions, T."""
        return len(self.actions)

    def with_image_offset(self, offset: int) -> "PreprocessedEpisode":
        """Return the same demonstration, its images `offset` further down a larger stack."""
        prompt, spurious = self.prompt, self.false_positives
        objects = prompt.objects.with_image_offset(offset)
        return replace(  # the records in it by their classes, which is faster
            self,
            prompt=PreprocessedPrompt(prompt.text, objects, prompt.objects_per_image, prompt.is_scene),
            objects=self.objects.with_image_offset(offset),
            false_positives=FalsePositives(offset_index(spurious.crop_index, offset), spurious.boxes),
            final=self.final.with_image_offset(offset),
        )


def preprocess(
    demo: Demonstration, kind: InputKind, extractor: ObjectExtractor | None = None
) -> PreprocessedEpisode:
    """Cut the inputs of a policy out of a demonstration.

    Args:
        demo: The demonstration.
        kind: "objects" for crops of the objects, "frames" for whole frames at half the size.
        extractor: Finds the objects, in prompt images too; None takes the segmentation.

    Raises:
        PolicyError: A view is missing, or objects have impossible ids.
    """
    stack = ImageStack(kind)
    observations = [demo.observation(t) for t in range(demo.num_steps)]
    extract_ahead(kind, extractor, observations=observations, prompts=[demo.prompt])
    prompt = preprocess_prompt(demo.prompt, kind, extractor, stack)
    views = [extract_observation(observation, kind, extractor) for observation in observations]
    objects = ObjectTable.from_views(ObjectViews.concatenate(views), stack)
    pick_ids, place_ids = np.array(demo.pick_ids, np.int16), np.array(demo.place_ids, np.int16)
    if extractor is not None:
        for t, (observation, found) in enumerate(zip(observations, views, strict=True)):
            slots = match_ids_to_slots(found, observe(observation))
            pick_ids[t], place_ids[t] = (slots.get(int(ids[t]), -1) for ids in (pick_ids, place_ids))
    shape = (demo.num_steps, len(VIEWS))
    false_positives = FalsePositives(np.zeros(shape, np.int32), np.zeros((*shape, 4), np.int16))
    if kind == "objects":
        # From the content alone, so that the cache does not depend on who makes it and in what order.
        rng = np.random.default_rng([demo.seed, *demo.task.encode()])
        _cut_false_positives(false_positives, observations, views, stack, rng)
    final = extract_observation(demo.observation(demo.num_steps), kind, extractor)
    return PreprocessedEpisode(
        task=demo.task,
        seed=demo.seed,
        end_effector=END_EFFECTORS.index(demo.end_effector),
        prompt=prompt,
        objects=objects,
        objects_per_step=np.array([len(found) for found in views], np.int16),
        pick_ids=pick_ids,
        place_ids=place_ids,
        false_positives=false_positives,
        final=ObjectTable.from_views(final, stack),
        actions=np.concatenate([*action_arrays(demo).values()], axis=1),
        images=stack.images()[1:],
        descriptions=image_descriptions(demo.prompt),
    )


def number_images(
    episodes: Sequence[PreprocessedEpisode], first_images: Sequence[int] | None = None
) -> list[PreprocessedEpisode]:
    """Number the images of demonstrations through, as in one stack of all of them after a blank image.

    Args:
        episodes: The demonstrations, as `preprocess` numbers them.
        first_images: Images before those of each, where the stack holds still more; None if it does not.
    """
    counts = np.array([len(episode.images) for episode in episodes])
    firsts = (np.cumsum(counts) - counts).tolist() if first_images is None else first_images
    return [episode.with_image_offset(first) for episode, first in zip(episodes, firsts, strict=True)]


def _cut_false_positives(
    false_positives: FalsePositives,
    observations: list[dict],
    views: list[ObjectViews],
    stack: ImageStack,
    rng: np.random.Generator,
) -> None:
    """Cut a rectangle of the size of a real box out of a random position of every image."""
    for t, (observation, objects) in enumerate(zip(observations, views, strict=True)):
        for v, view in enumerate(VIEWS):
            image = observation["rgb"][view]
            real = objects.boxes[v][objects.masks[v]]
            height, width = real[rng.integers(len(real)), 2:] if len(real) else (_SMALL_BOX, _SMALL_BOX)
            row, column = rng.integers(image.shape[1] - height), rng.integers(image.shape[2] - width)
            crop, false_positives.boxes[t, v] = crop_box(image, (column, column + width, row, row + height))
            false_positives.crop_index[t, v] = stack.add(crop)
