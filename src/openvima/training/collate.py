"""From tokens of demonstrations to padded batches: all episodes at once, without a loop over steps.

The result is what `Reader` and the batching of `policies.inputs` make of the same demonstrations when a
policy acts; the tests compare the two.

Shape suffixes: B batch, T steps, L prompt places, S objects in all prompts, N objects in view, V views.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from openvima.data.object_cache.episode import (
    BOXES,
    COUNT,
    GRASPS,
    ID,
    NUMBERS,
    PICK,
    PLACE,
    SPURIOUS_BOXES,
    SPURIOUS_NUMBERS,
    PreprocessedEpisode,
    pieces_of,
)
from openvima.errors import DatasetError
from openvima.perception.objects import FRONT, TOP
from openvima.policies.heads.base import ActionTargets
from openvima.policies.inputs import WORD, HistoryBatch, PromptBatch, Reader, on_table
from openvima.policies.tokenizer import PADDING_ID
from openvima.render.camera import CAMERAS, VIEWS, unproject
from openvima.training.dataset import Batch, Example, Spurious

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
        episodes = [example.tokens for example in examples]
        bases = np.array([example.base for example in examples], np.int64)
        steps = _Steps.of(episodes)
        history, slots = self._history(episodes, steps, bases)
        actions = steps.padded(np.concatenate([episode.actions for episode in episodes]))
        pick, place = (torch.from_numpy(steps.padded(column, fill=-1)) for column in slots)
        targets = ActionTargets(torch.from_numpy(actions), pick, place, history.steps_BT)
        return Batch(self._prompts(episodes, bases), history, targets, self._spurious(steps, bases))

    def _history(
        self, episodes: Sequence[PreprocessedEpisode], steps: "_Steps", bases: np.ndarray
    ) -> tuple[HistoryBatch, np.ndarray]:
        """Return what was seen, and the slots of the objects to pick and to place at, shape (2, steps)."""
        rows = np.concatenate([episode.objects for episode in episodes]).astype(np.int64)
        counts = steps.rows[:, COUNT]
        step = np.repeat(np.arange(len(counts)), counts)  # of each object
        slot = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        num_slots = self._num_slots(episodes, steps, counts)
        views = _ordered(rows, step) if self.reader.layout == "views" else (rows, rows)
        numbers = np.stack([view[:, NUMBERS][:, v] for v, view in enumerate(views)], axis=1)
        boxes = np.stack([view[:, BOXES].reshape(-1, 2, 4)[:, v] for v, view in enumerate(views)], axis=1)
        grasps = np.stack([view[:, GRASPS].reshape(-1, 2, 2)[:, v] for v, view in enumerate(views)], axis=1)
        shown = numbers > 0
        shape = (*steps.shape, len(VIEWS), max(1, int(num_slots.max(initial=0))))
        b, t = steps.b[step], steps.t[step]
        numbers_BTVN = np.zeros(shape, np.int64)
        boxes_BTVN4 = np.zeros((*shape, 4), np.int64)
        masks_BTVN = np.zeros(shape, np.bool_)
        numbers_BTVN[b, t, :, slot] = np.where(shown, numbers + bases[b][:, None], 0)
        boxes_BTVN4[b, t, :, slot] = boxes
        masks_BTVN[b, t, :, slot] = shown
        is_slot = np.arange(shape[3]) < num_slots[..., None]
        # A slot without an object has its box in the corner; so it is when a policy acts.
        empty = np.where(is_slot[..., None], unproject(np.zeros(2), CAMERAS["front"]), 0.0)
        positions_BTN2, grasps_BTN2 = empty, empty.copy()
        positions_BTN2[b, t, slot] = _on_table(boxes[..., :2], shown[:, TOP])
        grasps_BTN2[b, t, slot] = _on_table(grasps, shown[:, TOP])
        end_effector_BT = np.where(steps.exists, [[episode.end_effector] for episode in episodes], 0)
        arrays = (numbers_BTVN, boxes_BTVN4, masks_BTVN, num_slots, positions_BTN2, grasps_BTN2)
        history = HistoryBatch(
            *(torch.from_numpy(array) for array in (*arrays, end_effector_BT, steps.exists))
        )
        slots = np.full((2, len(counts)), -1)
        if self.reader.layout == "objects":  # elsewhere slots of two views need not show one object
            for row, column in enumerate((PICK, PLACE)):
                asked = rows[:, ID] == steps.rows[step, column]
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

    def _spurious(self, steps: "_Steps", bases: np.ndarray) -> Spurious:
        numbers = steps.rows[:, SPURIOUS_NUMBERS]
        boxes = steps.rows[:, SPURIOUS_BOXES].reshape(-1, len(VIEWS), 4)
        if self.reader.layout == "frames":
            points = np.zeros((len(boxes), len(VIEWS), 2))
        else:
            points = np.stack([unproject(boxes[:, v, :2], CAMERAS[view]) for v, view in enumerate(VIEWS)], 1)
        numbers = np.where(numbers > 0, numbers + bases[steps.b][:, None], 0)
        return Spurious(steps.padded(numbers), steps.padded(boxes), steps.padded(points))

    def _prompts(self, episodes: Sequence[PreprocessedEpisode], bases: np.ndarray) -> PromptBatch:
        prompts = [self._prompt(episode) for episode in episodes]
        total = sum(len(prompt.rows) for prompt in prompts)
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
            first += len(prompt.rows)
        rows = np.concatenate([prompt.rows for prompt in prompts]).astype(np.int64)
        base = np.repeat(bases, [len(prompt.rows) for prompt in prompts])[:, None]
        shown = rows[:, NUMBERS] > 0
        numbers_VS = np.ascontiguousarray(np.where(shown, rows[:, NUMBERS] + base, 0).T)
        boxes_VS4 = np.ascontiguousarray(rows[:, BOXES].reshape(-1, len(VIEWS), 4).swapaxes(0, 1))
        shown_VS = np.ascontiguousarray(shown.T)
        starts = np.cumsum([0, *(len(prompt.rows) for prompt in prompts)])
        lying = [
            on_table(prompt.places.images, boxes_VS4[:, start:end], shown_VS[:, start:end])
            for prompt, start, end in zip(prompts, starts[:-1], starts[1:], strict=True)
        ]
        arrays = (
            word_ids_BL,
            object_index_BL,
            mask_BL,
            numbers_VS,
            boxes_VS4,
            shown_VS,
            _on_table(boxes_VS4[..., :2].swapaxes(0, 1), shown[:, TOP]),
            np.concatenate([prompt.places.images for prompt in prompts]),
            np.concatenate(lying),
        )
        return PromptBatch(*(torch.from_numpy(array) for array in arrays))

    def _prompt(self, episode: PreprocessedEpisode) -> "_Prompt":
        """Lay out one prompt: words, and one token or several for each object of an image."""
        counts = tuple(episode.prompt_counts.tolist())
        if self.reader.layout != "views":
            places = self._places(episode.text, counts, ())
            rows = episode.prompt if places.order is None else episode.prompt[places.order]
            return _Prompt(places, rows, None)
        starts = np.cumsum([0, *counts])
        numbers = [piece for piece in pieces_of(episode.text) if isinstance(piece, int)]
        images = [episode.prompt[starts[number] : starts[number + 1]] for number in numbers]
        shown = [image[:, NUMBERS] > 0 for image in images]
        slots = tuple(max((int(image[:, v].sum()) for image in shown), default=0) for v in (FRONT, TOP))
        places = self._places(episode.text, counts, slots)
        rows = np.concatenate([_compacted(image, max(slots)) for image in images] or [episode.prompt[:0]])
        counts_as_place, shown = places.is_word.copy(), rows[:, NUMBERS] > 0
        is_image = ~places.is_word  # there may be none: a detector need not find anything
        counts_as_place[is_image] = shown[places.entries[is_image], places.parts[is_image]]
        return _Prompt(places, rows, counts_as_place)

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
        for piece in pieces_of(text):
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
    """One prompt: its places, one row an object, and which places count (None: all)."""

    places: _Places
    rows: np.ndarray
    mask: np.ndarray | None


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """All steps of a batch, one after the other, and where they stand in a padded array."""

    rows: np.ndarray  # (steps, columns of a step), int64
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
        return _Steps(np.concatenate([episode.steps for episode in episodes]).astype(np.int64), b, t, exists)

    def padded(self, column: np.ndarray, fill: int = 0) -> np.ndarray:
        """Spread one row a step over an array of shape (B, T, …)."""
        result = np.full((*self.shape, *column.shape[1:]), fill, column.dtype)
        result[self.b, self.t] = column
        return result


def _ordered(rows: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sort the objects of each step as each view shows them: visible ones first, then by id."""
    front, top = (rows[np.lexsort((rows[:, ID], rows[:, NUMBERS][:, v] == 0, step))] for v in (FRONT, TOP))
    return front, top


def _compacted(image: np.ndarray, count: int) -> np.ndarray:
    """The objects of a prompt image, in each view the visible ones first, in so many slots."""
    result = np.zeros((count, image.shape[1]), image.dtype)
    for v in (FRONT, TOP):
        shown = image[image[:, NUMBERS][:, v] > 0]
        box = slice(BOXES.start + 4 * v, BOXES.start + 4 * (v + 1))
        result[: len(shown), NUMBERS.start + v] = shown[:, NUMBERS.start + v]
        result[: len(shown), box] = shown[:, box]
    return result


def _on_table(pixels: np.ndarray, from_top: np.ndarray) -> np.ndarray:
    """Points under pixels of both views, shape (N, 2, 2): those of the top view where it shows the object."""
    front = unproject(pixels[:, FRONT], CAMERAS["front"])
    return np.where(from_top[:, None], unproject(pixels[:, TOP], CAMERAS["top"]), front)
