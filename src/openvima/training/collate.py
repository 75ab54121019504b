"""From tokens of demonstrations to padded batches: all episodes at once, without a loop over steps.

The result is what `Reader` and the batching of `policies.inputs` make of the same demonstrations when a
policy acts; the tests compare the two.

Shape suffixes: B batch, T steps, L prompt places, S objects in all prompts, N objects in view, V views.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from openvima.data.object_cache.episode import PreprocessedEpisode
from openvima.errors import DatasetError
from openvima.perception.objects import FRONT, TOP
from openvima.perception.preprocessing import ObjectTable, PreprocessedPrompt, offset_index, split_prompt
from openvima.policies.heads.base import ActionTargets
from openvima.policies.inputs import WORD, HistoryBatch, PromptBatch, Reader
from openvima.policies.tokenizer import PADDING_ID
from openvima.render.camera import CAMERAS, VIEWS, unproject
from openvima.training.dataset import Batch, Example, FalsePositiveBatch

MAX_KNOWN = 2**16  # prompts that a collator remembers


class Collator:
    """Makes batches for one network; it remembers how the prompts that it met are laid out.

    Args:
        reader: How the network sees prompts and observations.
    """

    def __init__(self, reader: Reader) -> None:
        self.reader = reader
        self._known: dict[tuple[str, tuple[int, ...], tuple[int, ...]], _Places] = {}

    def __call__(self, examples: Sequence[Example]) -> Batch:
        """Pad demonstrations to equal lengths.

        Raises:
            DatasetError: A demonstration has a step at which no object is in view.
            PromptError: A prompt has a word that the vocabulary lacks.
        """
        episodes = [example.episode for example in examples]
        bases = np.array([example.base for example in examples], np.int64)
        steps = _Steps.of(episodes)
        history, slots = self._history(episodes, steps, bases)
        actions = steps.padded(np.concatenate([episode.actions for episode in episodes]))
        pick, place = (torch.from_numpy(steps.padded(column, fill=-1)) for column in slots)
        targets = ActionTargets(torch.from_numpy(actions), pick, place, history.steps_BT)
        return Batch(
            self._prompts(episodes, bases), history, targets, self._false_positives(episodes, steps, bases)
        )

    def _history(
        self, episodes: Sequence[PreprocessedEpisode], steps: "_Steps", bases: np.ndarray
    ) -> tuple[HistoryBatch, np.ndarray]:
        """Return what was seen, and the slots of the objects to pick and to place at, shape (2, steps)."""
        objects = ObjectTable.concatenate([episode.objects for episode in episodes])
        counts = steps.objects_per_step
        step = np.repeat(np.arange(len(counts)), counts)  # of each object
        slot = np.arange(len(objects)) - np.repeat(np.cumsum(counts) - counts, counts)
        num_slots = self._num_slots(episodes, steps, counts)
        if self.reader.layout == "views":
            objects = _visible_first(objects, step)
        visible = objects.masks
        shape = (*steps.shape, len(VIEWS), max(1, int(num_slots.max(initial=0))))
        b, t = steps.b[step], steps.t[step]
        numbers_BTVN = np.zeros(shape, np.int64)
        boxes_BTVN4 = np.zeros((*shape, 4), np.int64)
        masks_BTVN = np.zeros(shape, np.bool_)
        numbers_BTVN[b, t, :, slot] = offset_index(objects.crop_index, bases[b][:, None])
        boxes_BTVN4[b, t, :, slot] = objects.boxes
        masks_BTVN[b, t, :, slot] = visible
        is_slot = np.arange(shape[3]) < num_slots[..., None]
        # A slot without an object has its box in the corner; so it is when a policy acts.
        empty = np.where(is_slot[..., None], unproject(np.zeros(2), CAMERAS["front"]), 0.0)
        positions_BTN2, grasps_BTN2 = empty, empty.copy()
        positions_BTN2[b, t, slot] = _on_table(objects.boxes[..., :2], visible[:, TOP])
        grasps_BTN2[b, t, slot] = _on_table(objects.grasps, visible[:, TOP])
        end_effector_BT = np.where(steps.exists, [[episode.end_effector] for episode in episodes], 0)
        arrays = (numbers_BTVN, boxes_BTVN4, masks_BTVN, num_slots, positions_BTN2, grasps_BTN2)
        history = HistoryBatch(
            *(torch.from_numpy(array) for array in (*arrays, end_effector_BT, steps.exists))
        )
        slots = np.full((2, len(counts)), -1)
        if self.reader.layout == "objects":  # elsewhere slots of two views need not show one object
            for row, ids in enumerate((steps.pick_ids, steps.place_ids)):
                asked = objects.ids == ids[step]
                slots[row, step[asked]] = slot[asked]
        return history, slots

    def _num_slots(
        self, episodes: Sequence[PreprocessedEpisode], steps: "_Steps", counts: np.ndarray
    ) -> np.ndarray:
        """Slots at each step, shape (B, T), int64; with a token for each view they never become fewer."""
        num_slots = steps.padded(counts)
        if self.reader.layout == "views":
            num_slots = np.where(steps.exists, np.maximum.accumulate(num_slots, axis=1), 0)
        blind = np.argwhere(steps.exists & (num_slots == 0))
        if len(blind):
            b, t = blind[0]
            raise DatasetError(
                f"episode {episodes[b].seed} of {episodes[b].task} shows no object before action {t}, so "
                "there is nothing to learn from it; leave it out."
            )
        return num_slots

    def _false_positives(
        self, episodes: Sequence[PreprocessedEpisode], steps: "_Steps", bases: np.ndarray
    ) -> FalsePositiveBatch:
        crop_index = np.concatenate([episode.false_positives.crop_index for episode in episodes])
        boxes = np.concatenate([episode.false_positives.boxes for episode in episodes]).astype(np.int64)
        if self.reader.layout == "frames":
            points = np.zeros((len(boxes), len(VIEWS), 2))
        else:
            points = np.stack([unproject(boxes[:, v, :2], CAMERAS[view]) for v, view in enumerate(VIEWS)], 1)
        crop_index = offset_index(crop_index, bases[steps.b][:, None])
        return FalsePositiveBatch(steps.padded(crop_index), steps.padded(boxes), steps.padded(points))

    def _prompts(self, episodes: Sequence[PreprocessedEpisode], bases: np.ndarray) -> PromptBatch:
        prompts = [self._prompt(episode.prompt) for episode in episodes]
        total = sum(len(prompt.objects) for prompt in prompts)
        length = max(len(prompt.places.words) for prompt in prompts)
        word_ids_BL = np.full((len(prompts), length), PADDING_ID, np.int64)
        object_index_BL = np.full((len(prompts), length), WORD, np.int64)
        mask_BL = np.zeros((len(prompts), length), np.bool_)
        first = 0
        for b, prompt in enumerate(prompts):
            places, size = prompt.places, len(prompt.places.words)
            word_ids_BL[b, :size] = places.words
            numbered = places.entries + (first + places.parts * total)
            object_index_BL[b, :size] = np.where(places.is_word, WORD, numbered)
            mask_BL[b, :size] = True if prompt.mask is None else prompt.mask
            first += len(prompt.objects)
        objects = ObjectTable.concatenate([prompt.objects for prompt in prompts])
        base = np.repeat(bases, [len(prompt.objects) for prompt in prompts])[:, None]
        visible = objects.masks
        arrays = (
            word_ids_BL,
            object_index_BL,
            mask_BL,
            np.ascontiguousarray(offset_index(objects.crop_index, base).T),
            np.ascontiguousarray(objects.boxes.swapaxes(0, 1).astype(np.int64)),
            np.ascontiguousarray(visible.T),
            _on_table(objects.boxes[..., :2], visible[:, TOP]),
            np.concatenate([prompt.places.images for prompt in prompts]),
            np.concatenate([prompt.is_scene[prompt.places.images] for prompt in prompts]),
        )
        return PromptBatch(*(torch.from_numpy(array) for array in arrays))

    def _prompt(self, prompt: PreprocessedPrompt) -> "_Prompt":
        """Lay out one prompt: words, and one token or several for each object of an image."""
        counts = tuple(prompt.objects_per_image.tolist())
        in_text = [piece for piece in split_prompt(prompt.text) if isinstance(piece, int)]
        is_scene = prompt.is_scene[in_text]
        if self.reader.layout != "views":
            places = self._places(prompt.text, counts, ())
            objects = prompt.objects if places.order is None else prompt.objects.select(places.order)
            return _Prompt(places, objects, is_scene, None)
        tables = prompt.objects.split(prompt.objects_per_image)
        images = [tables[number] for number in in_text]
        slots = tuple(
            np.array([image.masks.sum(axis=0) for image in images]).reshape(-1, 2).max(0, initial=0).tolist()
        )
        places = self._places(prompt.text, counts, slots)
        padded = [_compact(image, max(slots)) for image in images]
        objects = ObjectTable.concatenate(padded) if padded else prompt.objects.select(slice(0))
        mask, visible = places.is_word.copy(), objects.masks
        is_image = ~places.is_word  # there may be none: a detector need not find anything
        mask[is_image] = visible[places.entries[is_image], places.parts[is_image]]
        return _Prompt(places, objects, is_scene, mask)

    def _places(self, text: str, counts: tuple[int, ...], slots: tuple[int, ...]) -> "_Places":
        """Lay out a text whose images show so many objects; few texts differ, so they are remembered."""
        key = (text, counts, slots)
        if key not in self._known:
            if len(self._known) >= MAX_KNOWN:
                self._known.clear()
            self._known[key] = self._lay_out(*key)
        return self._known[key]

    def _lay_out(self, text: str, counts: tuple[int, ...], slots: tuple[int, ...]) -> "_Places":
        layout, tokenizer = self.reader.layout, self.reader.tokenizer
        places: list[tuple[int, int, int]] = []  # word, entry, part
        starts, order, count = np.cumsum([0, *counts]), [], 0
        sizes: list[int] = []  # rows of each image
        for piece in split_prompt(text):
            if isinstance(piece, str):
                places += [(word, WORD, 0) for word in tokenizer.encode(piece)]
                continue
            order += range(starts[piece], starts[piece + 1])
            sizes.append({"views": max(slots, default=0), "frames": 1, "objects": counts[piece]}[layout])
            if layout == "views":
                places += [(PADDING_ID, count + k, v) for v, size in enumerate(slots) for k in range(size)]
            elif layout == "frames":
                places += [(PADDING_ID, count, part) for part in range(self.reader.tokens_per_frame_pair)]
            else:
                places += [(PADDING_ID, count + k, 0) for k in range(counts[piece])]
            count += sizes[-1]
        places.append((tokenizer.end_id, WORD, 0))
        words, entries, parts = np.array(places).T
        in_order = order == list(range(starts[-1]))
        is_word, images = entries == WORD, np.repeat(np.arange(len(sizes)), sizes)
        in_other_order = None if in_order else np.array(order)
        return _Places(words, np.maximum(entries, 0), parts, is_word, images, in_other_order)


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """The places of a prompt: word, or row and part of what is shown; and the rows as the text shows them.

    `images` is the number of the image that each row is of, counted in reading order.
    """

    words: np.ndarray
    entries: np.ndarray
    parts: np.ndarray
    is_word: np.ndarray
    images: np.ndarray
    order: np.ndarray | None  # None: as they are stored


@dataclass(frozen=True, slots=True, eq=False)
class _Prompt:
    """One prompt: its places, its objects, which images are scenes, and which places count (None: all)."""

    places: _Places
    objects: ObjectTable
    is_scene: np.ndarray
    mask: np.ndarray | None


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """All steps of a batch, one after the other, and where they stand in a padded array."""

    objects_per_step: np.ndarray  # (steps,), int64
    pick_ids: np.ndarray
    place_ids: np.ndarray
    b: np.ndarray
    t: np.ndarray
    exists: np.ndarray  # (B, T)

    @property
    def shape(self) -> tuple[int, int]:
        return self.exists.shape

    @staticmethod
    def of(episodes: Sequence[PreprocessedEpisode]) -> "_Steps":
        lengths = np.array([episode.num_steps for episode in episodes])
        b = np.repeat(np.arange(len(episodes)), lengths)
        t = np.arange(len(b)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        exists = np.arange(lengths.max(initial=0)) < lengths[:, None]
        objects_per_step = np.concatenate([episode.objects_per_step for episode in episodes])
        pick_ids = np.concatenate([episode.pick_ids for episode in episodes])
        place_ids = np.concatenate([episode.place_ids for episode in episodes])
        return _Steps(objects_per_step.astype(np.int64), pick_ids, place_ids, b, t, exists)

    def padded(self, column: np.ndarray, fill: int = 0) -> np.ndarray:
        """Spread one row a step over an array of shape (B, T, …)."""
        result = np.full((*self.shape, *column.shape[1:]), fill, column.dtype)
        result[self.b, self.t] = column
        return result


def _visible_first(objects: ObjectTable, step: np.ndarray) -> ObjectTable:
    """Sort the objects of each step in each view by itself: visible ones first, then by id."""
    masks = objects.masks
    order = np.stack([np.lexsort((objects.ids, ~masks[:, v], step)) for v in (FRONT, TOP)], axis=1)
    return _reorder_views(objects, order)


def _compact(image: ObjectTable, count: int) -> ObjectTable:
    """Move the visible objects of an image to the front of each view, in so many slots."""
    order = np.argsort(~image.masks, axis=0, kind="stable")[:count]
    image = _reorder_views(image, order)
    extra = count - len(image)

    def pad(column: np.ndarray) -> np.ndarray:
        return np.pad(column, [(0, extra)] + [(0, 0)] * (column.ndim - 1))

    return ObjectTable(pad(image.ids), pad(image.crop_index), pad(image.boxes), pad(image.grasps))


def _reorder_views(objects: ObjectTable, order: np.ndarray) -> ObjectTable:
    """Reorder each view by itself, order (N, 2); a row need not be one object afterwards."""
    views = np.arange(len(VIEWS))
    return ObjectTable(
        objects.ids[: len(order)],
        objects.crop_index[order, views],
        objects.boxes[order, views],
        objects.grasps[order, views],
    )


def _on_table(pixels: np.ndarray, from_top: np.ndarray) -> np.ndarray:
    """Points under pixels of both views, shape (N, 2, 2): those of the top view where it shows the object."""
    front = unproject(pixels[:, FRONT], CAMERAS["front"])
    return np.where(from_top[:, None], unproject(pixels[:, TOP], CAMERAS["top"]), front)
