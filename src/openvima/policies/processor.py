"""Processor: prompts and observations to padded batches, for training and inference.

Inputs are first preprocessed into tables of objects (`openvima.perception.preprocessing`): by the object
cache in training, here in inference, whose batches have one step. All steps of a batch are padded at once,
without a loop over steps.

Shape suffixes: see `openvima.policies.batch`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from openvima.errors import DatasetError, PolicyError, PromptError
from openvima.perception.objects import FRONT, TOP, ObjectExtractor, ObjectViews, end_effector_of
from openvima.perception.preprocessing import (
    ImageStack,
    InputKind,
    ObjectTable,
    PreprocessedPrompt,
    extract_ahead,
    extract_observation,
    preprocess_prompt,
    split_prompt,
)
from openvima.policies.base import PromptLimits
from openvima.policies.batch import WORD, Batch, FalsePositiveBatch, HistoryBatch, PromptBatch
from openvima.policies.nn.actions import ActionTargets
from openvima.policies.nn.decoder import MAX_POSITIONS, MAX_PROMPT_POSITIONS, check_length
from openvima.policies.tokenizer import END_ID, PADDING_ID, Tokenizer, WordTokenizer
from openvima.render.camera import CAMERAS, VIEWS, unproject
from openvima.scene import RenderedPrompt

if TYPE_CHECKING:  # inference needs no demonstrations
    from openvima.data.preprocessed import FalsePositives, PreprocessedEpisode

MAX_LAYOUTS = 2**16  # token layouts of prompts to keep
# A token takes a character at least, and 16 are more than any word of the vocabularies has on average.
PROMPT_LIMITS = PromptLimits(16 * MAX_PROMPT_POSITIONS, objects=MAX_PROMPT_POSITIONS)

_LayoutKey = tuple[str, tuple[int, ...], bytes]


@dataclass(frozen=True, slots=True, eq=False)
class Processor:
    """Encodes prompts and observations as network inputs.

    Args:
        layout: What a token encodes, see `InputLayout`, of which a network's config has one as `inputs`.
        tokens_per_image: Number of tokens of both views of an image; 0 if it depends on its objects.
        tokenizer: Tokenizer of prompt text; by default that of the benchmark's vocabulary.
        extractor: Object extractor for inference; None uses the segmentation.
    """

    layout: Literal["objects", "views", "frames"]
    tokens_per_image: int = 0
    tokenizer: Tokenizer = field(default_factory=WordTokenizer)
    extractor: ObjectExtractor | None = None
    _layouts: "dict[_LayoutKey, _Layout]" = field(default_factory=dict, init=False, repr=False)

    @property
    def input_kind(self) -> InputKind:
        """Kind of images: crops of objects, or whole frames."""
        return "frames" if self.layout == "frames" else "objects"

    def encode_prompts(self, prompts: Sequence[RenderedPrompt]) -> tuple[PromptBatch, ImageStack]:
        """Encode prompts for inference.

        Args:
            prompts: One for each episode.

        Returns:
            The batch, and its image stack.

        Raises:
            PromptError: A prompt is empty or too large, T5 lacks a word, or placeholders and images do not
                match.
            PolicyError: An image lacks a view, or a prompt has too many tokens.
            ShapeError: An image has another shape or dtype.
        """
        for prompt in prompts:
            PROMPT_LIMITS.check(prompt)
        if not all(prompt.sequence() for prompt in prompts):
            raise PromptError("the prompt is empty; it must hold at least one word or image.")
        stack = ImageStack(self.input_kind)
        extract_ahead(self.input_kind, self.extractor, prompts=prompts)
        preprocessed = [preprocess_prompt(each, self.input_kind, self.extractor, stack) for each in prompts]
        return self.batch_prompts(preprocessed), stack

    def encode_observations(
        self,
        histories: Sequence[Sequence[Mapping]],
        num_slots: Sequence[int] | None = None,
        stack: ImageStack | None = None,
    ) -> tuple[HistoryBatch, ImageStack]:
        """Encode observations for inference.

        Args:
            histories: Consecutive observations of each episode, only the last one in inference: `rgb` and
                `segm`, each view name to array, and `ee`, the index of the end effector. `segm` only if the
                extractor uses it.
            num_slots: With layout "views", slots of each episode before these observations, the last of
                `num_slots_BT`; None at the start of episodes. An object keeps its slot when it is hidden in
                both views, so their number never falls within an episode, as in the published evaluation.
            stack: Image stack to extend; None starts a new one.

        Returns:
            The batch, and its image stack.

        Raises:
            PolicyError: A part or a view is missing, there is no such end effector, or there are too many
                objects or none. With layout "views" there may be none after the first step.
            ShapeError: An image has another shape or dtype.
        """
        stack = stack or ImageStack(self.input_kind)
        observations = [each for history in histories for each in history]
        end_effectors = np.array([end_effector_of(each) for each in observations])
        extract_ahead(self.input_kind, self.extractor, observations=observations)
        found = [extract_observation(each, self.input_kind, self.extractor) for each in observations]
        steps = _Steps.of([len(history) for history in histories])
        counts = np.array([len(objects) for objects in found], np.int64)
        slots_BT = self._num_slots(steps, counts, np.array(num_slots or [0] * len(histories)))
        if (slots_BT == 0)[steps.exist()].any():
            raise PolicyError(
                "the observation contains no object. Check its segmentation, or the "
                "detector and its min_score."
            )
        limit = MAX_POSITIONS // (len(VIEWS) if self.layout == "views" else 1) - 1
        if counts.max() > limit:
            raise PolicyError(
                f"the observation shows {counts.max()} objects; this policy takes {limit}. Raise its "
                "min_score."
            )
        objects = ObjectTable.from_views(ObjectViews.concatenate(found), stack)
        return self._batch_history(objects, counts, steps, slots_BT, end_effectors), stack

    def batch_prompts(self, prompts: Sequence[PreprocessedPrompt]) -> PromptBatch:
        """Pad prompts to equal length and number objects across the batch."""
        # Layouts say where tokens and objects of a prompt go; they are few, and cached. What is left are flat
        # arrays of all tokens (W,) and of all objects (S,) of the batch, without a loop over either.
        layouts = [self._layout_of(prompt) for prompt in prompts]
        # All tokens, and where they stand in the padded arrays.
        word, row, part, is_valid = np.concatenate([layout.tokens for layout in layouts]).T
        lengths = np.array([len(layout.tokens) for layout in layouts])
        place = _rows_and_slots(lengths)
        shape = (len(prompts), int(lengths.max(initial=0)))
        # All objects that they stand for; an image that is named twice has its objects twice.
        counts = np.array([len(layout.rows) for layout in layouts])
        b = np.repeat(np.arange(len(prompts)), counts)
        image_index, image, *own_rows = np.concatenate([layout.rows for layout in layouts]).T
        rows = np.stack(own_rows, axis=1)
        rows += np.where(rows >= 0, _starts([len(prompt.objects) for prompt in prompts])[b][:, None], 0)
        objects = _select_views(ObjectTable.concatenate([prompt.objects for prompt in prompts]), rows)
        in_scene = np.concatenate([prompt.is_scene for prompt in prompts])
        first_of = _starts([len(prompt.is_scene) for prompt in prompts])
        word_ids_BL, object_index_BL = np.full(shape, PADDING_ID), np.full(shape, WORD)
        mask_BL = np.zeros(shape, np.bool_)
        word_ids_BL[place] = word
        # Numbered by part first: all first tokens of objects (their front views) before all second ones.
        object_index_BL[place] = np.where(row == WORD, WORD, row + part * len(b) + _starts(counts)[place[0]])
        mask_BL[place] = is_valid
        arrays = (
            word_ids_BL,
            object_index_BL,
            mask_BL,
            np.isin(word_ids_BL, self.tokenizer.texture_ids),
            objects.crop_index.T.astype(np.int64),
            objects.boxes.swapaxes(0, 1).astype(np.int64),
            objects.masks.T,
            _table_points(objects, objects.boxes[..., :2]),
            image_index,
            in_scene[first_of[b] + image],
        )
        return PromptBatch(*(torch.from_numpy(np.ascontiguousarray(array)) for array in arrays))

    def collate(self, episodes: "Sequence[PreprocessedEpisode]") -> Batch:
        """Pad demonstrations to equal lengths.

        Args:
            episodes: The demonstrations, their images numbered in one stack, see `number_images`.

        Raises:
            DatasetError: A demonstration has a step without visible objects.
            PromptError: A prompt has a word that T5 lacks.
        """
        steps = _Steps.of([episode.num_steps for episode in episodes])
        counts = np.concatenate([episode.objects_per_step for episode in episodes]).astype(np.int64)
        slots_BT = self._num_slots(steps, counts, np.zeros(len(episodes), np.int64))
        for b, t in () if counts.all() else np.argwhere(steps.exist() & (slots_BT == 0))[:1]:
            raise DatasetError(
                f"episode {episodes[b].seed} of {episodes[b].task} shows no object before action {t}, so "
                "it cannot be trained on; exclude it."
            )
        objects = ObjectTable.concatenate([episode.objects for episode in episodes])
        history = self._batch_history(
            objects,
            counts,
            steps,
            slots_BT,
            np.array([episode.end_effector for episode in episodes])[steps.b],
        )
        pick, place = (
            self._slots_of(np.concatenate([getattr(episode, name) for episode in episodes]), objects, counts)
            for name in ("pick_ids", "place_ids")
        )
        targets = ActionTargets(
            torch.from_numpy(steps.pad(np.concatenate([episode.actions for episode in episodes]))),
            torch.from_numpy(steps.pad(pick, fill=-1)),
            torch.from_numpy(steps.pad(place, fill=-1)),
            history.steps_BT,
        )
        return Batch(
            self.batch_prompts([episode.prompt for episode in episodes]),
            history,
            targets,
            self._batch_false_positives([episode.false_positives for episode in episodes], steps),
        )

    def _batch_history(
        self,
        objects: ObjectTable,
        counts: np.ndarray,
        steps: "_Steps",
        slots_BT: np.ndarray,
        end_effectors: np.ndarray,
    ) -> HistoryBatch:
        """Pad the objects of all steps to slots; counts and end effectors are those of steps."""
        step, slot = _rows_and_slots(counts)
        if self.layout == "views":
            # In each view separately.
            orders = [order_in_view(objects.ids, objects.masks[:, v], step) for v in (FRONT, TOP)]
            objects = _select_views(objects, np.stack(orders, axis=1))
        (count, length), num_slots = steps.shape, max(1, int(slots_BT.max(initial=0)))
        place = steps.place[step]
        crop_index, masks = np.zeros((2, count * length, len(VIEWS), num_slots), np.int64)
        boxes = np.zeros((count * length, len(VIEWS), num_slots, 4), np.int64)
        crop_index[place, :, slot], masks[place, :, slot] = objects.crop_index, objects.masks
        boxes[place, :, slot] = objects.boxes
        # A slot that has lost its object is at the corner of the front view.
        is_slot = np.arange(num_slots) < slots_BT.reshape(-1, 1)
        positions = np.where(is_slot[..., None], unproject(np.zeros(2), CAMERAS["front"]), 0.0)
        grasps = positions.copy()
        positions[place, slot] = _table_points(objects, objects.boxes[..., :2])
        grasps[place, slot] = _table_points(objects, objects.grasps)
        flat = (crop_index, boxes, masks.astype(np.bool_), slots_BT.reshape(-1), positions, grasps)
        padded = [array.reshape(*steps.shape, *array.shape[1:]) for array in flat]
        arrays = (*padded, steps.pad(end_effectors), steps.exist())
        return HistoryBatch(*(torch.from_numpy(array) for array in arrays))

    def _slots_of(self, ids: np.ndarray, objects: ObjectTable, counts: np.ndarray) -> np.ndarray:
        """Return the slot of the object that has the id of its step, shape (T,), -1 where there is none."""
        slots = np.full(len(counts), -1)
        if self.layout == "objects":  # elsewhere slots of two views need not be one object
            step, slot = _rows_and_slots(counts)
            found = objects.ids == ids[step]
            slots[step[found]] = slot[found]
        return slots

    def _num_slots(self, steps: "_Steps", counts: np.ndarray, before_B: np.ndarray) -> np.ndarray:
        """Slots at each step, shape (B, T), int64; never decreasing with layout "views"."""
        slots_BT = steps.pad(counts)
        if self.layout != "views":
            return slots_BT
        slots_BT = np.maximum.accumulate(np.maximum(slots_BT, before_B[:, None]), axis=1)
        return np.where(steps.exist(), slots_BT, 0)

    def _batch_false_positives(
        self, found: "Sequence[FalsePositives]", steps: "_Steps"
    ) -> FalsePositiveBatch:
        crop_index = np.concatenate([each.crop_index for each in found]).astype(np.int64)
        boxes = np.concatenate([each.boxes for each in found]).astype(np.int64)
        points = np.zeros((*crop_index.shape, 2))
        if self.layout != "frames":
            for v, view in enumerate(VIEWS):
                points[:, v] = unproject(boxes[:, v, :2], CAMERAS[view])
        return FalsePositiveBatch(*(steps.pad(column) for column in (crop_index, boxes, points)))

    def _layout_of(self, prompt: PreprocessedPrompt) -> "_Layout":
        """Return the layout of a prompt, cached by its text and by what decides the objects of its images."""
        masks = prompt.objects.masks if self.layout == "views" else np.zeros((0, len(VIEWS)), np.bool_)
        key = (prompt.text, tuple(prompt.objects_per_image.tolist()), masks.tobytes())
        if key not in self._layouts:
            if len(self._layouts) >= MAX_LAYOUTS:
                self._layouts.clear()
            self._layouts[key] = self._lay_out(prompt.text, key[1], masks)
        return self._layouts[key]

    def _lay_out(self, text: str, counts: tuple[int, ...], masks: np.ndarray) -> "_Layout":
        """Lay out words, and one or more tokens for each object of an image.

        With layout "views" the visible objects of each view come first, and every image is padded to the
        slots of the prompt's largest one, as in the published evaluation, where this affects T5's relative
        positions.
        """
        pieces = split_prompt(text)
        # Warns once of all unknown words.
        self.tokenizer.encode(" ".join(piece for piece in pieces if isinstance(piece, str)))
        in_text = [piece for piece in pieces if isinstance(piece, int)]
        starts, by_view, slots = _starts(counts), self.layout == "views", [0] * len(VIEWS)
        # Rows of the table that fill the slots of each image, by view.
        rows = [[np.arange(starts[n], starts[n] + counts[n])] * len(VIEWS) for n in in_text]
        if by_view and rows:
            rows = [[own[masks[own, v]] for v, own in enumerate(image)] for image in rows]
            slots = [max(map(len, view)) for view in zip(*rows, strict=True)]
            rows = [
                [np.pad(own, (0, max(slots) - len(own)), constant_values=-1) for own in image]
                for image in rows
            ]
        shown = [np.stack(image, axis=1) for image in rows]
        tokens: list[tuple[int, int, int, bool]] = []  # word, row, part, whether it is valid
        count, unread = 0, iter(shown)
        for piece in pieces:
            if isinstance(piece, str):
                tokens += [(word, WORD, 0, True) for word in self.tokenizer.encode(piece)]
                continue
            own = next(unread)
            if self.tokens_per_image:  # all of the first object
                places = [(0, part, True) for part in range(self.tokens_per_image)] if len(own) else []
            elif by_view:
                places = [(k, v, own[k, v] >= 0) for v, size in enumerate(slots) for k in range(size)]
            else:
                places = [(k, 0, True) for k in range(len(own))]
            tokens += [(PADDING_ID, count + k, part, is_valid) for k, part, is_valid in places]
            count += len(own)
        tokens.append((END_ID, WORD, 0, True))
        # Before the encoder, whose cost is quadratic.
        check_length(len(tokens), MAX_PROMPT_POSITIONS, "the prompt")
        sizes = [len(own) for own in shown]
        numbers = np.array([range(len(sizes)), in_text], np.int64).repeat(sizes, axis=1).T
        none = np.zeros((0, len(VIEWS)), np.int64)
        return _Layout(np.array(tokens), np.concatenate([numbers, np.concatenate([none, *shown])], axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """The tokens of a prompt, and the objects that they stand for.

    Args:
        tokens: Word, row of its object below or `WORD`, part of that, and whether it is valid, shape (L, 4).
        rows: Image of the object, counted in reading order, number of that image in the prompt, and rows in
            the prompt's table, of each view, -1 for an empty slot, shape (R, 4).
    """

    tokens: np.ndarray
    rows: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """Episode `b` of each step, its place in a padded array, and the shape (B, T) of that."""

    b: np.ndarray
    place: np.ndarray
    shape: tuple[int, int]

    @staticmethod
    def of(lengths: Sequence[int] | np.ndarray) -> "_Steps":
        """Number the steps of episodes of these lengths."""
        lengths = np.asarray(lengths, np.int64)
        b, t = _rows_and_slots(lengths)
        shape = (len(lengths), int(lengths.max(initial=0)))
        return _Steps(b, b * shape[1] + t, shape)

    def exist(self) -> np.ndarray:
        """Where a padded array holds steps, shape (B, T), bool."""
        return self.pad(np.ones(len(self.place), np.bool_))

    def pad(self, column: np.ndarray, fill: int = 0) -> np.ndarray:
        """Scatter one row per step into a padded array of shape (B, T, …)."""
        count, length = self.shape
        result = np.full((count * length, *column.shape[1:]), fill, column.dtype)
        result[self.place] = column
        return result.reshape(*self.shape, *column.shape[1:])


def _rows_and_slots(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and place in it of each element, from the number of elements of each row."""
    row = np.repeat(np.arange(len(counts)), counts)
    return row, np.arange(len(row)) - _starts(counts)[row]


def _starts(counts: Sequence[int] | np.ndarray) -> np.ndarray:
    """Where each of several consecutive parts begins, from their lengths."""
    return np.cumsum(counts, dtype=np.int64) - counts


def _table_points(objects: ObjectTable, pixels: np.ndarray) -> np.ndarray:
    """Points on the table under pixels (N, 2 views, 2): those of the top view, or else the front view."""
    front, top = (unproject(pixels[:, v], CAMERAS[view]) for v, view in enumerate(VIEWS))
    return np.where(objects.masks[:, TOP, None], top, front)


def order_in_view(ids: np.ndarray, is_visible: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the order of objects in one view of layout "views": by step, visible ones first, then by id."""
    return np.lexsort((ids, ~is_visible, step))


def _select_views(objects: ObjectTable, rows: np.ndarray) -> ObjectTable:
    """Select rows of each view separately, (N, 2), of nothing where it is -1; a row may then mix objects."""
    views, exists = np.arange(len(VIEWS)), rows >= 0
    columns = (column[rows, views] for column in (objects.crop_index, objects.boxes, objects.grasps))
    return ObjectTable(np.full(len(rows), -1), *(np.where(exists.T, column.T, 0).T for column in columns))
