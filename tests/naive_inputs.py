"""The naive twin of `Processor`: prompts and observations one by one, as a policy that acts reads them.

It shares only the extraction of objects with the processor. Golden recordings, whose slots are given as they
are, are batched with it too.

Shape suffixes: see `openvima.policies.batch`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch

from openvima.perception.objects import (
    GROUND_TRUTH,
    GroundTruth,
    ObjectExtractor,
    ObjectViews,
    end_effector_of,
    make_hidden_objects,
    observe,
    whole_frames,
)
from openvima.policies.batch import WORD, HistoryBatch, InputLayout, PromptBatch
from openvima.policies.tokenizer import END_ID, PADDING_ID, Tokenizer, WordTokenizer
from openvima.render.camera import VIEWS
from openvima.scene import PromptImage, RenderedPrompt


@dataclass(frozen=True, slots=True, eq=False)
class PromptInput:
    """One prompt.

    Args:
        words: Word id at each place, shape (L,), int64; padding where an image token stands.
        entries: Row of the object (or frame pair) at each place, shape (L,), int64; `WORD` where a word
            stands.
        parts: Which of its tokens stands there, shape (L,), int64: the view, front before top; the number of
            the token, with frames; 0 where one token shows both views.
        mask: Which places count, shape (L,), bool; not those of objects hidden in their view.
        objects: All objects of all images, one row an appearance in the text.
        numbers: Which image shows each of them, counted from 0 in reading order, shape (S,), int64.
        in_scene: Whether that is an image of the table, shape (S,), bool.
        names_texture: Which words name a texture, shape (L,), bool; None if none does.
    """

    words: np.ndarray
    entries: np.ndarray
    parts: np.ndarray
    mask: np.ndarray
    objects: ObjectViews
    numbers: np.ndarray
    in_scene: np.ndarray
    names_texture: np.ndarray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class StepInput:
    """One observation.

    Args:
        objects: The objects in view; or both frames, as one object that fills them.
        positions: Table points under their boxes, shape (N, 2), metres.
        grasps: Table points under their most interior pixels, shape (N, 2), metres.
        end_effector: 0 suction cup, 1 spatula.
    """

    objects: ObjectViews
    positions: np.ndarray
    grasps: np.ndarray
    end_effector: int


class PublishedOrder(GroundTruth):
    """Finds objects in the order of their ids, as the published evaluation does."""

    def in_observation(self, observation: Mapping) -> ObjectViews:
        objects = observe(observation)
        return objects.select(np.argsort(objects.ids))


PUBLISHED_ORDER = PublishedOrder()


def compacted(objects: ObjectViews) -> ObjectViews:
    """Move the visible objects of each view to the front; a slot is then no object in both views."""
    order = np.argsort(~objects.masks, axis=1, kind="stable")
    rows = np.arange(len(VIEWS))[:, None]
    views = (objects.crops, objects.boxes, objects.masks, objects.grasps)
    return ObjectViews(np.full_like(objects.ids, -1), *(array[rows, order] for array in views))


def padded(objects: ObjectViews, count: int) -> ObjectViews:
    """Append hidden objects up to a number of them."""
    return ObjectViews.concatenate([objects, make_hidden_objects(max(0, count - len(objects)))])


@dataclass(frozen=True, slots=True)
class NaiveProcessor:
    """Turns prompts and observations into what a network takes; the same for training and acting.

    Args:
        layout: What a token shows: an object in both views, an object in one view, or part of a whole frame.
        tokens_per_image: How many tokens both views of an image become; 0 if that depends on its objects.
        tokenizer: Splits text into word ids.
        extractor: Finds the objects in images.
    """

    layout: Literal["objects", "views", "frames"]
    tokens_per_image: int = 0
    tokenizer: Tokenizer = field(default_factory=WordTokenizer)
    extractor: ObjectExtractor = GROUND_TRUTH

    @staticmethod
    def of(
        inputs: InputLayout,
        tokenizer: Tokenizer | None = None,
        extractor: ObjectExtractor | None = None,
    ) -> "NaiveProcessor":
        """Make the processor for a network that takes such inputs."""
        tokenizer = tokenizer or WordTokenizer()
        order = PUBLISHED_ORDER if inputs.tokens == "views" else GROUND_TRUTH
        return NaiveProcessor(inputs.tokens, inputs.tokens_per_image, tokenizer, extractor or order)

    def encode_prompt(self, prompt: RenderedPrompt) -> PromptInput:
        """Turn a prompt into words and images."""
        places: list[tuple[int, int, int, bool]] = []  # word, entry, part, counts
        sequence = prompt.sequence()
        images = [self._see_prompt_image(piece) for piece in sequence if isinstance(piece, PromptImage)]
        slots = _widest(images)
        if self.layout == "views":
            # What comes after the fullest view's objects is hidden in both.
            images = [
                padded(image.select(np.arange(len(image)) < max(slots)), max(slots)) for image in images
            ]
        count, unread = 0, iter(images)
        for piece in sequence:
            if isinstance(piece, str):
                places += [(word, WORD, 0, True) for word in self.tokenizer.encode(piece)]
                continue
            image = next(unread)
            places += [
                (PADDING_ID, count + entry, part, valid) for entry, part, valid in self._places(image, slots)
            ]
            count += len(image)
        places.append((END_ID, WORD, 0, True))
        words, entries, parts, mask = (np.array(column) for column in zip(*places, strict=True))
        numbers = np.repeat(np.arange(len(images)), [len(image) for image in images])
        kinds = [piece.kind == "scene" for piece in sequence if isinstance(piece, PromptImage)]
        in_scene = np.array(kinds, np.bool_)[numbers]
        named = np.isin(words, self.tokenizer.texture_ids)
        return PromptInput(
            words, entries, parts, mask, ObjectViews.concatenate(images), numbers, in_scene, named
        )

    def start_episode(self) -> "NaiveEpisode":
        """Return the processor of one episode's observations."""
        return NaiveEpisode(self)

    def _see_prompt_image(self, image: PromptImage) -> ObjectViews:
        if self.layout == "frames":
            return whole_frames(image.rgb)
        objects = self.extractor.in_prompt_image(image)
        return objects if self.layout == "objects" else compacted(objects)

    def _places(self, objects: ObjectViews, slots: Sequence[int]) -> list[tuple[int, int, bool]]:
        """Entry, part and validity of the tokens of one image, in the order of the prompt.

        With a token for each view, every image takes as many slots as the prompt's fullest one, as in the
        published evaluation: T5 counts them, and so tells how far words and images are apart.
        """
        if self.tokens_per_image:
            return [(0, part, True) for part in range(self.tokens_per_image if len(objects) else 0)]
        if self.layout == "objects":
            return [(k, 0, bool(visible)) for k, visible in enumerate(objects.visible())]
        return [(k, v, bool(objects.masks[v, k])) for v, count in enumerate(slots) for k in range(count)]


class NaiveEpisode:
    """Reads the observations of one episode, in order.

    With a token for each view, an object that was seen once keeps its slots when it is hidden in both views.
    So the number of slots never falls within an episode, as in the published evaluation.
    """

    def __init__(self, processor: NaiveProcessor) -> None:
        self._processor = processor
        self._num_slots = 0

    def encode_step(self, observation: Mapping) -> StepInput:
        """Turn an observation into objects.

        Args:
            observation: `rgb` and `segm`, each view name to array, and `ee`, the index of the end effector.
                `segm` only where objects are found by it.
        """
        layout, end_effector = self._processor.layout, end_effector_of(observation)
        if layout == "frames":
            frames = whole_frames(observation["rgb"])
            centre = frames.positions()
            return StepInput(frames, centre, centre, end_effector)
        objects = self._processor.extractor.in_observation(observation)
        if layout == "views":
            self._num_slots = max(self._num_slots, len(objects))
            objects = padded(compacted(objects), self._num_slots)
        return StepInput(objects, objects.positions(), objects.grasp_points(), end_effector)


def _widest(images: Sequence[ObjectViews]) -> list[int]:
    """The largest number of visible objects in each view of a prompt's images."""
    return [max((int(image.masks[view].sum()) for image in images), default=0) for view in range(len(VIEWS))]


def batch_prompts(prompts: Sequence[PromptInput], crops: Sequence[np.ndarray]) -> PromptBatch:
    """Pad prompts to equal length and number their objects through.

    Args:
        prompts: The prompts.
        crops: For each prompt the numbers of its objects' images, shape (2, objects).
    """
    length = max(len(prompt.words) for prompt in prompts)
    words = np.full((len(prompts), length), PADDING_ID)
    images = np.full((len(prompts), length), WORD)
    mask, named = np.zeros((2, len(prompts), length), np.bool_)
    first, total = 0, sum(len(prompt.objects) for prompt in prompts)
    for row, prompt in enumerate(prompts):
        size = len(prompt.words)
        words[row, :size] = prompt.words
        numbered = prompt.entries + first + prompt.parts * total
        images[row, :size] = np.where(prompt.entries == WORD, WORD, numbered)
        mask[row, :size] = prompt.mask
        named[row, :size] = False if prompt.names_texture is None else prompt.names_texture
        first += len(prompt.objects)
    objects = [prompt.objects for prompt in prompts]
    arrays = (
        *(words, images, mask, named),
        np.concatenate(list(crops), axis=1),
        np.concatenate([each.boxes for each in objects], axis=1),
        np.concatenate([each.masks for each in objects], axis=1),
        np.concatenate([each.positions() for each in objects]),
        np.concatenate([prompt.numbers for prompt in prompts]),
        np.concatenate([prompt.in_scene for prompt in prompts]),
    )
    return PromptBatch(*map(torch.from_numpy, arrays))


def batch_histories(
    histories: Sequence[Sequence[StepInput]], crops: Sequence[Sequence[np.ndarray]]
) -> HistoryBatch:
    """Pad episodes to equal numbers of steps and of objects.

    Args:
        histories: The steps of each episode.
        crops: For each step the numbers of its objects' images, shape (2, objects).
    """
    batch, steps = len(histories), max(len(history) for history in histories)
    count = max([1, *(len(step.objects) for history in histories for step in history)])
    numbers = np.zeros((batch, steps, 2, count), np.int64)
    boxes = np.zeros((batch, steps, 2, count, 4), np.int64)
    masks = np.zeros((batch, steps, 2, count), np.bool_)
    counts = np.zeros((batch, steps), np.int64)
    positions = np.zeros((batch, steps, count, 2), np.float64)
    grasps = np.zeros((batch, steps, count, 2), np.float64)
    end_effector = np.zeros((batch, steps), np.int64)
    exists = np.zeros((batch, steps), np.bool_)
    for b, history in enumerate(histories):
        for t, step in enumerate(history):
            size = len(step.objects)
            numbers[b, t, :, :size] = crops[b][t]
            boxes[b, t, :, :size] = step.objects.boxes
            masks[b, t, :, :size] = step.objects.masks
            counts[b, t] = size
            positions[b, t, :size] = step.positions
            grasps[b, t, :size] = step.grasps
            end_effector[b, t] = step.end_effector
            exists[b, t] = True
    arrays = (numbers, boxes, masks, counts, positions, grasps, end_effector, exists)
    return HistoryBatch(*map(torch.from_numpy, arrays))
