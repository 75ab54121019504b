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
from openvima.perception.kernels import CROP_SIZE
from openvima.perception.objects import FRONT, TOP, ObjectExtractor, ObjectViews, end_effector_of
from openvima.perception.preprocessing import (
    ImageStack,
    InputKind,
    ObjectTable,
    PreprocessedPrompt,
    extract_ahead,
    extract_observation,
    offset_index,
    preprocess_prompt,
    split_prompt,
)
from openvima.policies.base import PromptLimits
from openvima.policies.batch import WORD, Batch, FalsePositiveBatch, HistoryBatch, InputLayout, PromptBatch
from openvima.policies.nn.actions import ActionTargets
from openvima.policies.nn.decoder import MAX_POSITIONS, MAX_PROMPT_POSITIONS, check_length
from openvima.policies.tokenizer import PADDING_ID, Tokenizer, WordTokenizer
from openvima.render.camera import CAMERAS, VIEWS, unproject
from openvima.scene import RenderedPrompt

if TYPE_CHECKING:  # inference needs no demonstrations
    from openvima.data.preprocessed import FalsePositives, PreprocessedEpisode

MAX_LAYOUTS = 2**16  # token layouts of prompts to keep
# A token takes a character at least, and 16 are more than any word of the vocabularies has on average.
PROMPT_LIMITS = PromptLimits(16 * MAX_PROMPT_POSITIONS, objects=MAX_PROMPT_POSITIONS)

_LayoutKey = tuple[str, tuple[int, ...], tuple[int, ...]]


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
        return self._batch_history(objects, counts, steps, slots_BT, np.array(end_effectors)), stack

    def batch_prompts(
        self, prompts: Sequence[PreprocessedPrompt], first_images: np.ndarray | None = None
    ) -> PromptBatch:
        """Pad prompts to equal length and number objects across the batch.

        Args:
            prompts: The prompts.
            first_images: Images of the stack before those of each prompt; None where there is one stack.
        """
        layouts, tables, masks = zip(*map(self._token_sequence, prompts), strict=True)
        # All tokens, and where they stand in the padded arrays.
        word, row, part = np.concatenate([layout.tokens for layout in layouts]).T
        lengths = np.array([len(layout.tokens) for layout in layouts])
        place = _rows_and_slots(lengths)
        shape = (len(prompts), int(lengths.max(initial=0)))
        # All objects that they stand for; an image that is named twice has its objects twice.
        counts = np.array([len(layout.rows) for layout in layouts])
        image_index, image, own_row = np.concatenate([layout.rows for layout in layouts]).T
        b = np.repeat(np.arange(len(prompts)), counts)
        objects = ObjectTable.concatenate(tables).select(own_row + _starts(list(map(len, tables)))[b])
        if first_images is not None:
            objects = objects.with_image_offset(first_images[b][:, None])
        in_scene = np.concatenate([prompt.is_scene for prompt in prompts])
        first_of = _starts([len(prompt.is_scene) for prompt in prompts])
        word_ids_BL, object_index_BL = np.full(shape, PADDING_ID), np.full(shape, WORD)
        mask_BL = np.zeros(shape, np.bool_)
        word_ids_BL[place] = word
        object_index_BL[place] = np.where(row == WORD, WORD, row + part * len(b) + _starts(counts)[place[0]])
        mask_BL[place] = np.concatenate(masks)
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

    def collate(
        self, episodes: "Sequence[PreprocessedEpisode]", first_images: Sequence[int] | None = None
    ) -> Batch:
        """Pad demonstrations to equal lengths.

        Args:
            episodes: The demonstrations.
            first_images: Images before those of each demonstration, in one stack of all after a blank image;
                None stacks those of the batch.

        Raises:
            DatasetError: A demonstration has a step without visible objects.
            PromptError: A prompt has a word that T5 lacks.
        """
        if first_images is None:
            first_images = _starts([len(episode.images) for episode in episodes])
        offsets_B = np.array(first_images, np.int64)
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
            objects.with_image_offset(np.repeat(offsets_B[steps.b], counts)[:, None]),
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
            self.batch_prompts([episode.prompt for episode in episodes], offsets_B),
            history,
            targets,
            self._batch_false_positives([e.false_positives for e in episodes], steps, offsets_B[steps.b]),
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
            objects = _visible_first(objects, step)
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
        return HistoryBatch(
            *(
                torch.from_numpy(array.reshape(*steps.shape, *array.shape[1:]))
                for array in (crop_index, boxes, masks.astype(np.bool_))
            ),
            torch.from_numpy(slots_BT),
            *(torch.from_numpy(array.reshape(*steps.shape, num_slots, 2)) for array in (positions, grasps)),
            torch.from_numpy(steps.pad(end_effectors)),
            torch.from_numpy(steps.exist()),
        )

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
        self, found: "Sequence[FalsePositives]", steps: "_Steps", offsets: np.ndarray
    ) -> FalsePositiveBatch:
        crop_index = np.concatenate([each.crop_index for each in found])
        boxes = np.concatenate([each.boxes for each in found]).astype(np.int64)
        points = np.zeros((*crop_index.shape, 2))
        if self.layout != "frames":
            for v, view in enumerate(VIEWS):
                points[:, v] = unproject(boxes[:, v, :2], CAMERAS[view])
        crop_index = offset_index(crop_index, offsets[:, None])
        return FalsePositiveBatch(*(steps.pad(column) for column in (crop_index, boxes, points)))

    def _token_sequence(self, prompt: PreprocessedPrompt) -> tuple["_Layout", ObjectTable, np.ndarray]:
        """Return the tokens of a prompt, its objects, and which tokens are valid.

        Tokens are words, and one or more for each object of an image. With layout "views" the visible objects
        of each view come first, and every image is padded to the slots of the prompt's largest one, as in the
        published evaluation, where this affects T5's relative positions.
        """
        counts = prompt.objects_per_image
        if self.layout != "views":
            layout = self._layout_of(prompt.text, tuple(counts.tolist()), ())
            return layout, prompt.objects, np.ones(len(layout.tokens), np.bool_)
        in_text = [piece for piece in split_prompt(prompt.text) if isinstance(piece, int)]
        ends = np.cumsum(counts)
        rows = [np.arange(ends[number] - counts[number], ends[number]) for number in in_text]
        image = np.repeat(np.arange(len(rows)), [len(each) for each in rows])
        ordered = prompt.objects.select(np.concatenate([np.zeros(0, np.int64), *rows]))
        objects, slots = _compact(ordered, image, len(rows))
        layout = self._layout_of(prompt.text, tuple(counts.tolist()), slots)
        _, entries, parts = layout.tokens.T
        mask = (entries == WORD) | bool(self.tokens_per_image)
        mask[~mask] = objects.masks[entries[~mask], parts[~mask]]
        return layout, objects, mask

    def _layout_of(self, text: str, counts: tuple[int, ...], slots: tuple[int, ...]) -> "_Layout":
        """Return the cached layout of a text, given the number of objects per image."""
        key = (text, counts, slots)
        if key not in self._layouts:
            if len(self._layouts) >= MAX_LAYOUTS:
                self._layouts.clear()
            self._layouts[key] = self._lay_out(text, counts, slots)
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
        exist = np.zeros(self.shape, np.bool_)
        exist.reshape(-1)[self.place] = True
        return exist

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
