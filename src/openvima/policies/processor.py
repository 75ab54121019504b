"""Processor: prompts and observations to padded batches, for training and inference.

Inputs are first preprocessed into tables of objects (`openvima.perception.preprocessing`): by the object
cache in training, here in inference, whose batches have one step. All steps of a batch are padded at once,
without a loop over steps.

Shape suffixes: see `openvima.policies.batch`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch

from openvima.errors import DatasetError, PolicyError, PromptError
from openvima.perception.image_stack import ImageStack
from openvima.perception.kernels import CROP_SIZE
from openvima.perception.objects import FRONT, TOP, ObjectExtractor, ObjectViews, end_effector_of
from openvima.perception.preprocessing import (
    InputKind,
    ObjectTable,
    PreprocessedPrompts,
    extract_ahead,
    extract_observation,
    preprocess_prompt,
    split_prompt,
)
from openvima.policies.base import PromptLimits
from openvima.policies.batch import WORD, Batch, FalsePositiveBatch, HistoryBatch, InputLayout, PromptBatch
from openvima.policies.kernels import (
    find_slots,
    int64,
    pad_false_positives,
    pad_history,
    pad_prompts,
    stack_prompt_objects,
)
from openvima.policies.nn.actions import ActionTargets
from openvima.policies.nn.decoder import MAX_POSITIONS, MAX_PROMPT_POSITIONS, check_length
from openvima.policies.tokenizer import PADDING_ID, Tokenizer, WordTokenizer
from openvima.render.camera import CAMERAS, VIEWS
from openvima.scene import RenderedPrompt

if TYPE_CHECKING:  # inference needs no demonstrations
    from openvima.data.object_cache.episode import FalsePositives
    from openvima.data.object_cache.episode_batch import EpisodeBatch

MAX_LAYOUTS = 2**16  # token layouts of prompts to keep
# A token takes a character at least, and 16 are more than any word of the vocabularies has on average.
PROMPT_LIMITS = PromptLimits(16 * MAX_PROMPT_POSITIONS, objects=MAX_PROMPT_POSITIONS)

_LayoutKey = tuple[str, bytes, tuple[int, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Processor:
    """Encodes prompts and observations as network inputs.

    Args:
        layout: What a token encodes: "objects", an object in both views; "views", an object in one view (the
            published VIMA); "frames", part of a whole frame.
        image_size: Height and width of a crop or frame.
        tokens_per_image: Number of tokens of both views of an image; 0 if it depends on its objects.
        tokenizer: Tokenizer of prompt text; by default that of the benchmark's vocabulary.
        extractor: Object extractor for inference; None uses the segmentation.
    """

    layout: Literal["objects", "views", "frames"]
    image_size: tuple[int, int] = (CROP_SIZE, CROP_SIZE)
    tokens_per_image: int = 0
    tokenizer: Tokenizer = field(default_factory=WordTokenizer)
    extractor: ObjectExtractor | None = None
    _layouts: "dict[_LayoutKey, _Layout]" = field(default_factory=dict, init=False, repr=False)

    @staticmethod
    def of(
        inputs: InputLayout,
        tokenizer: Tokenizer | None = None,
        extractor: ObjectExtractor | None = None,
    ) -> "Processor":
        """Return a `Processor` for a network with this input layout."""
        return Processor(
            inputs.tokens,
            inputs.image_size,
            inputs.tokens_per_image,
            tokenizer or WordTokenizer(),
            extractor,
        )

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
        stack = ImageStack(self.image_size)
        extract_ahead(self.input_kind, self.extractor, prompts=prompts)
        preprocessed = [preprocess_prompt(each, self.input_kind, self.extractor, stack) for each in prompts]
        return self.batch_prompts(PreprocessedPrompts.of(preprocessed)), stack

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
        stack = stack or ImageStack(self.image_size)
        if num_slots is None or self.layout != "views":
            num_slots = [0] * len(histories)
        extract_ahead(
            self.input_kind, self.extractor, observations=[each for own in histories for each in own]
        )
        found: list[ObjectViews] = []
        end_effectors: list[int] = []
        for history, slots in zip(histories, num_slots, strict=True):
            for observation in history:
                end_effectors.append(end_effector_of(observation))
                objects = extract_observation(observation, self.input_kind, self.extractor, self.image_size)
                self._check_count(len(objects), slots)
                slots = max(slots, len(objects)) if self.layout == "views" else 0
                found.append(objects)
        steps = _Steps.of([len(history) for history in histories])
        counts = np.array([len(objects) for objects in found], np.int64)
        objects = ObjectTable.from_views(ObjectViews.concatenated(found), stack)
        slots_BT = self._num_slots(steps, counts, np.array(num_slots))
        offsets = np.zeros_like(counts)
        return self._batch_history(objects, counts, steps, slots_BT, np.array(end_effectors), offsets), stack

    def batch_prompts(
        self, prompts: PreprocessedPrompts, image_offsets: np.ndarray | None = None
    ) -> PromptBatch:
        """Pad prompts to equal length and number objects across the batch.

        Args:
            prompts: The prompts.
            image_offsets: Images of the stack before those of each prompt; None where there is one stack.
        """
        sequences = self._token_sequences(prompts)
        layouts = sequences.layouts
        lengths = np.array([len(layout.tokens) for layout in layouts])
        tokens = np.concatenate([layout.tokens for layout in layouts])
        counts = np.array([len(layout.rows) for layout in layouts])
        image_index, shown, order = np.concatenate([layout.rows for layout in layouts]).T
        first = np.cumsum(counts) - counts
        prompt = np.repeat(np.arange(len(layouts)), counts)
        first_image = np.cumsum(prompts.num_images) - prompts.num_images
        shape = (len(layouts), int(lengths.max(initial=0)))
        word_ids_BL, object_index_BL = np.full(shape, PADDING_ID), np.full(shape, WORD)
        mask_BL = np.zeros(shape, np.bool_)
        is_valid = np.ones(len(tokens), np.bool_) if sequences.mask is None else sequences.mask
        pad_prompts(lengths, first, len(order), tokens, is_valid, word_ids_BL, object_index_BL, mask_BL)
        objects = sequences.objects
        shape = (len(VIEWS), len(order))
        crop_index_VS, masks_VS = np.empty(shape, np.int64), np.empty(shape, np.bool_)
        boxes_VS4, positions_S2 = np.empty((*shape, 4), np.int64), np.empty((len(order), 2))
        stack_prompt_objects(
            _cameras(),
            np.zeros(len(order), np.int64) if image_offsets is None else image_offsets[prompt],
            order + (np.cumsum(sequences.num_objects) - sequences.num_objects)[prompt],
            int64(objects.crop_index),
            int64(objects.boxes),
            crop_index_VS,
            boxes_VS4,
            masks_VS,
            positions_S2,
        )
        arrays = (
            word_ids_BL,
            object_index_BL,
            mask_BL,
            np.isin(word_ids_BL, self.tokenizer.texture_ids),
            crop_index_VS,
            boxes_VS4,
            masks_VS,
            positions_S2,
            np.ascontiguousarray(image_index),
            prompts.is_scene[first_image[prompt] + shown],
        )
        return PromptBatch(*(torch.from_numpy(array) for array in arrays))

    def collate(self, episodes: "EpisodeBatch") -> Batch:
        """Pad demonstrations to equal lengths.

        Args:
            episodes: The demonstrations.

        Raises:
            DatasetError: A demonstration has a step without visible objects.
            PromptError: A prompt has a word that T5 lacks.
        """
        steps = _Steps.of(episodes.num_steps)
        counts, objects = episodes.objects_per_step.astype(np.int64), episodes.objects
        slots_BT = self._num_slots(steps, counts, np.zeros(len(episodes.num_steps), np.int64))
        for b, t in () if counts.all() else np.argwhere(steps.exist() & (slots_BT == 0))[:1]:
            raise DatasetError(
                f"episode {episodes.seeds[b]} of {episodes.tasks[b]} shows no object before action {t}, so "
                "it cannot be trained on; exclude it."
            )
        pick, place = np.full((2, len(counts)), -1)
        if self.layout == "objects":  # elsewhere slots of two views need not be one object
            ids = int64(objects.ids)
            find_slots(counts, ids, int64(episodes.pick_ids), pick)
            find_slots(counts, ids, int64(episodes.place_ids), place)
        offsets = episodes.image_offsets[steps.b]
        end_effectors = episodes.end_effectors[steps.b]
        history = self._batch_history(objects, counts, steps, slots_BT, end_effectors, offsets)
        targets = ActionTargets(
            torch.from_numpy(steps.pad(episodes.actions)),
            torch.from_numpy(steps.pad(pick, fill=-1)),
            torch.from_numpy(steps.pad(place, fill=-1)),
            history.steps_BT,
        )
        return Batch(
            self.batch_prompts(episodes.prompts, episodes.image_offsets),
            history,
            targets,
            self._batch_false_positives(episodes.false_positives, steps, offsets),
        )

    def _batch_history(
        self,
        objects: ObjectTable,
        counts: np.ndarray,
        steps: "_Steps",
        slots_BT: np.ndarray,
        end_effectors: np.ndarray,
        offsets: np.ndarray,
    ) -> HistoryBatch:
        """Pad the objects of all steps to slots; counts, end effectors, offsets are those of steps."""
        if self.layout == "views":
            objects = _visible_first(objects, _steps_and_slots(counts)[0])
        (count, length), num_slots = steps.shape, max(1, int(slots_BT.max(initial=0)))
        shape = (count, length, len(VIEWS), num_slots)
        crop_index_BTVN, masks_BTVN = np.zeros(shape, np.int64), np.zeros(shape, np.bool_)
        boxes_BTVN4 = np.zeros((*shape, 4), np.int64)
        positions_BTN2, grasps_BTN2 = np.zeros((2, count, length, num_slots, 2))
        padded = (crop_index_BTVN, boxes_BTVN4, masks_BTVN, positions_BTN2, grasps_BTN2)
        pad_history(
            _cameras(),
            steps.place,
            counts,
            slots_BT.reshape(-1)[steps.place],
            offsets,
            int64(objects.crop_index),
            int64(objects.boxes),
            int64(objects.grasps),
            *(array.reshape(-1, *array.shape[2:]) for array in padded),
        )
        arrays = (
            crop_index_BTVN,
            boxes_BTVN4,
            masks_BTVN,
            slots_BT,
            positions_BTN2,
            grasps_BTN2,
            steps.pad(end_effectors),
            steps.exist(),
        )
        return HistoryBatch(*(torch.from_numpy(array) for array in arrays))

    def _num_slots(self, steps: "_Steps", counts: np.ndarray, before_B: np.ndarray) -> np.ndarray:
        """Slots at each step, shape (B, T), int64; never decreasing with layout "views"."""
        slots_BT = steps.pad(counts)
        if self.layout != "views":
            return slots_BT
        slots_BT = np.maximum.accumulate(np.maximum(slots_BT, before_B[:, None]), axis=1)
        return np.where(steps.exist(), slots_BT, 0)

    def _check_count(self, count: int, num_slots: int) -> None:
        """Reject an observation without objects, or with more than the decoder has positions for."""
        if not count and not num_slots:
            raise PolicyError(
                "the observation contains no object. Check its segmentation, or the "
                "detector and its min_score."
            )
        limit = MAX_POSITIONS // (len(VIEWS) if self.layout == "views" else 1) - 1
        if count > limit:
            raise PolicyError(
                f"the observation shows {count} objects; this policy takes {limit}. Raise its min_score."
            )

    def _batch_false_positives(
        self, found: "FalsePositives", steps: "_Steps", offsets: np.ndarray
    ) -> FalsePositiveBatch:
        padded = (
            np.zeros((*steps.shape, len(VIEWS)), np.int64),
            np.zeros((*steps.shape, len(VIEWS), 4), np.int64),
            np.zeros((*steps.shape, len(VIEWS), 2)),
        )
        pad_false_positives(
            _cameras(),
            self.layout != "frames",
            steps.place,
            offsets,
            int64(found.crop_index),
            int64(found.boxes),
            *(array.reshape(-1, *array.shape[2:]) for array in padded),
        )
        return FalsePositiveBatch(*padded)

    def _token_sequences(self, prompts: PreprocessedPrompts) -> "_TokenSequences":
        """Build the token sequences of prompts: words, and one or more tokens per object of an image.

        With layout "views" every image is padded to the slots of the prompt's largest one, as in the
        published evaluation, where this affects T5's relative positions.
        """
        stored, ends = int64(prompts.objects_per_image), np.cumsum(prompts.num_images)
        bounds = zip((ends - prompts.num_images).tolist(), ends.tolist(), strict=True)
        content, size = stored.tobytes(), stored.itemsize
        counts = [content[size * start : size * end] for start, end in bounds]
        if self.layout == "views":
            return self._in_views(prompts, counts)
        layouts = self._layouts
        found = [
            layouts.get((text, each, ())) or self._layout_of(text, each, ())
            for text, each in zip(prompts.texts, counts, strict=True)
        ]
        objects_before = np.concatenate([[0], np.cumsum(stored)])
        num_objects = objects_before[ends] - objects_before[ends - prompts.num_images]
        return _TokenSequences(found, prompts.objects, num_objects, None)

    def _in_views(self, prompts: PreprocessedPrompts, images: Sequence[bytes]) -> "_TokenSequences":
        """Move the visible objects of each view to the front; slots differ from prompt to prompt."""
        layouts, tables, masks = [], [], []
        counts_of = [np.frombuffer(each, np.int64) for each in images]
        tables_of = prompts.objects.split(np.array([counts.sum() for counts in counts_of]))
        for text, counts, table in zip(prompts.texts, counts_of, tables_of, strict=True):
            in_text = [piece for piece in split_prompt(text) if isinstance(piece, int)]
            ends = np.cumsum(counts)
            rows = [np.arange(ends[number] - counts[number], ends[number]) for number in in_text]
            image = np.repeat(np.arange(len(rows)), [len(each) for each in rows])
            ordered = table.select(np.concatenate([np.zeros(0, np.int64), *rows]))
            objects, slots = _compact(ordered, image, len(rows))
            layout = self._layout_of(text, counts.tobytes(), slots)
            _, entries, parts = layout.tokens.T
            mask = (entries == WORD) | bool(self.tokens_per_image)
            mask[~mask] = objects.masks[entries[~mask], parts[~mask]]
            layouts.append(layout)
            tables.append(objects)
            masks.append(mask)
        num_objects = np.array([len(table) for table in tables])
        return _TokenSequences(layouts, ObjectTable.concatenate(tables), num_objects, np.concatenate(masks))

    def _layout_of(self, text: str, counts: bytes, slots: tuple[int, ...]) -> "_Layout":
        """Return the cached layout of a text, given the number of objects per image, int64."""
        key = (text, counts, slots)
        if key not in self._layouts:
            if len(self._layouts) >= MAX_LAYOUTS:
                self._layouts.clear()
            self._layouts[key] = self._lay_out(text, np.frombuffer(counts, np.int64).tolist(), slots)
        return self._layouts[key]

    def _lay_out(self, text: str, counts: Sequence[int], slots: tuple[int, ...]) -> "_Layout":
        tokens: list[tuple[int, int, int]] = []  # word, entry, part
        starts, order, count = np.cumsum([0, *counts]), [], 0
        sizes: list[int] = []  # rows of each image
        pieces = split_prompt(text)
        # Warns once of all unknown words.
        self.tokenizer.encode(" ".join(piece for piece in pieces if isinstance(piece, str)))
        for piece in pieces:
            if isinstance(piece, str):
                tokens += [(word, WORD, 0) for word in self.tokenizer.encode(piece)]
                continue
            order += range(starts[piece], starts[piece + 1])
            sizes.append({"views": max(slots, default=0), "frames": 1, "objects": counts[piece]}[self.layout])
            if self.tokens_per_image:
                parts = self.tokens_per_image if sizes[-1] else 0  # of the first object
                tokens += [(PADDING_ID, count, part) for part in range(parts)]
            elif self.layout == "views":
                tokens += [(PADDING_ID, count + k, v) for v, size in enumerate(slots) for k in range(size)]
            else:
                tokens += [(PADDING_ID, count + k, 0) for k in range(counts[piece])]
            count += sizes[-1]
        tokens.append((self.tokenizer.end_id, WORD, 0))
        check_length(
            len(tokens), MAX_PROMPT_POSITIONS, "the prompt"
        )  # before the encoder, whose cost is quadratic
        in_text = [piece for piece in split_prompt(text) if isinstance(piece, int)]
        rows = [
            np.repeat(np.arange(len(sizes)), sizes),
            np.repeat(np.array(in_text, np.int64), sizes),
            np.arange(count) if self.layout == "views" else np.array(order, np.int64),
        ]
        return _Layout(np.array(tokens), np.stack(rows, axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """The tokens of a prompt, (L, 3): word, row of its object or `WORD`, and part of that.

    `rows` (R, 3) has for each row the image, counted in reading order, its number in the prompt, and the row
    in the table of objects, which may be in another order.
    """

    tokens: np.ndarray
    rows: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class _TokenSequences:
    """Prompts: layout of each, objects of all, number in each, and mask of all tokens (None: all valid)."""

    layouts: list[_Layout]
    objects: ObjectTable
    num_objects: np.ndarray
    mask: np.ndarray | None


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
        b, t = _steps_and_slots(lengths)
        shape = (len(lengths), int(lengths.max(initial=0)))
        return _Steps(b, b * shape[1] + t, shape)

    def exist(self) -> np.ndarray:
        """Where a padded array holds steps, shape (B, T), bool."""
        exist = np.zeros(self.shape, np.bool_)
        exist.reshape(-1)[self.place] = True
        return exist

    def pad(self, column: np.ndarray, fill: int = 0) -> np.ndarray:
        """Scatter one row per step into a padded array of shape (B, T, …)."""
        count, length = self.shape
        result = np.full((count * length, *column.shape[1:]), fill, column.dtype)
        result[self.place] = column
        return result.reshape(*self.shape, *column.shape[1:])


def _steps_and_slots(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Step and slot of each object, from the number of objects of each step."""
    step = np.repeat(np.arange(len(counts)), counts)
    return step, np.arange(len(step)) - np.repeat(np.cumsum(counts) - counts, counts)


def _visible_first(objects: ObjectTable, step: np.ndarray) -> ObjectTable:
    """Sort the objects of each step separately in each view: visible ones first, then by id."""
    masks = objects.masks
    order = np.stack([np.lexsort((objects.ids, ~masks[:, v], step)) for v in (FRONT, TOP)], axis=1)
    return _reorder_views(objects, order)


def _compact(objects: ObjectTable, image: np.ndarray, num_images: int) -> tuple[ObjectTable, tuple[int, ...]]:
    """Move the visible objects of each image to the front of each view, in equally many slots.

    Returns:
        Slots of all images, and the maximum number per image in each view.
    """
    rows = [np.flatnonzero(visible) for visible in objects.masks.T]
    counts = [np.bincount(image[of_view], minlength=num_images) for of_view in rows]
    slots = tuple(int(count.max(initial=0)) for count in counts)
    columns = (objects.crop_index, objects.boxes, objects.grasps)
    size = num_images * max(slots)
    compact = [np.zeros((size, *column.shape[1:]), column.dtype) for column in columns]
    for v, (of_view, count) in enumerate(zip(rows, counts, strict=True)):
        rank = np.arange(len(of_view)) - (np.cumsum(count) - count)[image[of_view]]
        slot = image[of_view] * max(slots) + rank
        for new, old in zip(compact, columns, strict=True):
            new[slot, v] = old[of_view, v]
    return ObjectTable(np.full(size, -1), *compact), slots


def _reorder_views(objects: ObjectTable, order: np.ndarray) -> ObjectTable:
    """Reorder each view separately, order (N, 2); afterwards a row may mix objects."""
    views = np.arange(len(VIEWS))
    return ObjectTable(
        np.full(len(order), -1),
        objects.crop_index[order, views],
        objects.boxes[order, views],
        objects.grasps[order, views],
    )


@cache
def _cameras() -> np.ndarray:
    """The cameras of the views as matrices, shape (2, 4, 4)."""
    return np.stack([CAMERAS[view].matrix() for view in VIEWS])
