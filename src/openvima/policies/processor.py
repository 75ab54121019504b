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
from openvima.perception.image_stack import ImageStack
from openvima.perception.kernels import CROP_SIZE
from openvima.perception.objects import FRONT, TOP, ObjectExtractor, ObjectViews, end_effector_of
from openvima.perception.preprocessing import (
    InputKind,
    ObjectTable,
    PreprocessedPrompt,
    extract_observation,
    offset_index,
    preprocess_prompt,
    split_prompt,
)
from openvima.policies.batch import WORD, Batch, FalsePositiveBatch, HistoryBatch, PromptBatch
from openvima.policies.input_layout import InputLayout
from openvima.policies.nn.actions import ActionTargets
from openvima.policies.nn.decoder import MAX_POSITIONS, MAX_PROMPT_POSITIONS, check_length
from openvima.policies.prompt_limits import PromptLimits
from openvima.policies.tokenizer import CLOSED_TOKENIZER, PADDING_ID, Tokenizer
from openvima.render.camera import CAMERAS, VIEWS, unproject
from openvima.scene import RenderedPrompt

if TYPE_CHECKING:  # inference needs no demonstrations
    from openvima.data.object_cache.episode import PreprocessedEpisode

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
        tokens_per_frame_pair: With frames, number of tokens of the two frames of a step.
        tokenizer: Tokenizer of prompt text.
        extractor: Object extractor for inference; None uses the segmentation.
    """

    layout: Literal["objects", "views", "frames"]
    image_size: tuple[int, int] = (CROP_SIZE, CROP_SIZE)
    tokens_per_frame_pair: int = 0
    tokenizer: Tokenizer = CLOSED_TOKENIZER
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
            inputs.tokens_per_frame_pair,
            tokenizer or CLOSED_TOKENIZER,
            extractor,
        )

    @property
    def input_kind(self) -> InputKind:
        """Kind of images: crops of objects, or whole frames."""
        return "frames" if self.layout == "frames" else "objects"

    def encode_prompts(
        self, prompts: Sequence[RenderedPrompt], stack: ImageStack | None = None
    ) -> tuple[PromptBatch, ImageStack]:
        """Encode prompts for inference.

        Args:
            prompts: One for each episode.
            stack: Image stack to extend; None starts a new one.

        Returns:
            The batch, and its image stack.

        Raises:
            PromptError: A prompt is empty or too large, a word is unknown, or placeholders and images do not
                match.
            PolicyError: An image lacks a view, or a prompt has too many tokens.
            ShapeError: An image has another shape or dtype.
        """
        for prompt in prompts:
            PROMPT_LIMITS.check(prompt)
        if not all(prompt.sequence() for prompt in prompts):
            raise PromptError("the prompt is empty; it must hold at least one word or image.")
        stack = stack or ImageStack(self.image_size)
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
        self, prompts: Sequence[PreprocessedPrompt], image_offsets: Sequence[int] | None = None
    ) -> PromptBatch:
        """Pad prompts to equal length and number objects across the batch.

        Args:
            prompts: The prompts.
            image_offsets: Images of the stack before those of each prompt; None where there is one stack.
        """
        sequences = [self._token_sequence(prompt) for prompt in prompts]
        counts = [len(sequence.objects) for sequence in sequences]
        length = max(len(sequence.layout.words) for sequence in sequences)
        word_ids_BL = np.full((len(prompts), length), PADDING_ID, np.int64)
        object_index_BL = np.full((len(prompts), length), WORD, np.int64)
        mask_BL = np.zeros((len(prompts), length), np.bool_)
        first, total = 0, sum(counts)
        for b, sequence in enumerate(sequences):
            layout, size = sequence.layout, len(sequence.layout.words)
            word_ids_BL[b, :size] = layout.words
            numbered = layout.entries + (first + layout.parts * total)
            object_index_BL[b, :size] = np.where(layout.is_word, WORD, numbered)
            mask_BL[b, :size] = True if sequence.mask is None else sequence.mask
            first += counts[b]
        objects = ObjectTable.concatenate([sequence.objects for sequence in sequences])
        offsets = np.repeat([0] * len(prompts) if image_offsets is None else image_offsets, counts)[:, None]
        visible = objects.masks
        arrays = (
            word_ids_BL,
            object_index_BL,
            mask_BL,
            np.ascontiguousarray(offset_index(objects.crop_index, offsets).T),
            np.ascontiguousarray(objects.boxes.swapaxes(0, 1).astype(np.int64)),
            np.ascontiguousarray(visible.T),
            _on_table(objects.boxes[..., :2], visible[:, TOP]),
            np.concatenate([sequence.layout.images for sequence in sequences]),
            np.concatenate([sequence.is_scene[sequence.layout.images] for sequence in sequences]),
        )
        return PromptBatch(*(torch.from_numpy(array) for array in arrays))

    def collate(
        self, episodes: "Sequence[PreprocessedEpisode]", image_offsets: Sequence[int] | None = None
    ) -> Batch:
        """Pad demonstrations to equal lengths.

        Args:
            episodes: The demonstrations.
            image_offsets: Images of the stack before those of each demonstration; None where there is one
                stack.

        Raises:
            DatasetError: A demonstration has a step without visible objects.
            PromptError: A prompt has a word that the vocabulary lacks.
        """
        offsets = np.array([0] * len(episodes) if image_offsets is None else image_offsets, np.int64)
        steps = _Steps.of([episode.num_steps for episode in episodes])
        counts = np.concatenate([episode.objects_per_step for episode in episodes]).astype(np.int64)
        slots_BT = self._num_slots(steps, counts, np.zeros(len(episodes), np.int64))
        for b, t in np.argwhere(steps.exists & (slots_BT == 0))[:1]:
            raise DatasetError(
                f"episode {episodes[b].seed} of {episodes[b].task} shows no object before action {t}, so "
                "it cannot be trained on; exclude it."
            )
        objects = ObjectTable.concatenate([episode.objects for episode in episodes])
        step, slot = _steps_and_slots(counts)
        pick, place = np.full((2, len(counts)), -1)
        if self.layout == "objects":  # elsewhere slots of two views need not be one object
            for slots, name in ((pick, "pick_ids"), (place, "place_ids")):
                ids = np.concatenate([getattr(episode, name) for episode in episodes])
                is_target = objects.ids == ids[step]
                slots[step[is_target]] = slot[is_target]
        objects = objects.with_image_offset(offsets[steps.b[step]][:, None])
        end_effectors = np.array([episode.end_effector for episode in episodes], np.int64)[steps.b]
        history = self._batch_history(objects, counts, steps, slots_BT, end_effectors)
        targets = ActionTargets(
            torch.from_numpy(steps.pad(np.concatenate([episode.actions for episode in episodes]))),
            torch.from_numpy(steps.pad(pick, fill=-1)),
            torch.from_numpy(steps.pad(place, fill=-1)),
            history.steps_BT,
        )
        prompts = self.batch_prompts([episode.prompt for episode in episodes], offsets.tolist())
        return Batch(prompts, history, targets, self._batch_false_positives(episodes, steps, offsets))

    def _batch_history(
        self,
        objects: ObjectTable,
        counts: np.ndarray,
        steps: "_Steps",
        slots_BT: np.ndarray,
        end_effectors: np.ndarray,
    ) -> HistoryBatch:
        """Pad the objects of all steps to slots; counts and end effectors have one entry per step."""
        step, slot = _steps_and_slots(counts)
        if self.layout == "views":
            objects = _visible_first(objects, step)
        visible = objects.masks
        shape = (*steps.exists.shape, len(VIEWS), max(1, int(slots_BT.max(initial=0))))
        b, t = steps.b[step], steps.t[step]
        crop_index_BTVN = np.zeros(shape, np.int64)
        boxes_BTVN4 = np.zeros((*shape, 4), np.int64)
        masks_BTVN = np.zeros(shape, np.bool_)
        crop_index_BTVN[b, t, :, slot] = objects.crop_index
        boxes_BTVN4[b, t, :, slot] = objects.boxes
        masks_BTVN[b, t, :, slot] = visible
        is_slot = np.arange(shape[3]) < slots_BT[..., None]
        # The box of a slot without an object is at the image's corner.
        positions_BTN2 = np.where(is_slot[..., None], unproject(np.zeros(2), CAMERAS["front"]), 0.0)
        grasps_BTN2 = positions_BTN2.copy()
        positions_BTN2[b, t, slot] = _on_table(objects.boxes[..., :2], visible[:, TOP])
        grasps_BTN2[b, t, slot] = _on_table(objects.grasps, visible[:, TOP])
        arrays = (
            crop_index_BTVN,
            boxes_BTVN4,
            masks_BTVN,
            slots_BT,
            positions_BTN2,
            grasps_BTN2,
            steps.pad(end_effectors),
            steps.exists,
        )
        return HistoryBatch(*(torch.from_numpy(array) for array in arrays))

    def _num_slots(self, steps: "_Steps", counts: np.ndarray, before_B: np.ndarray) -> np.ndarray:
        """Slots at each step, shape (B, T), int64; never decreasing with layout "views"."""
        slots_BT = steps.pad(counts)
        if self.layout != "views":
            return slots_BT
        slots_BT = np.maximum.accumulate(np.maximum(slots_BT, before_B[:, None]), axis=1)
        return np.where(steps.exists, slots_BT, 0)

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
        self, episodes: "Sequence[PreprocessedEpisode]", steps: "_Steps", offsets: np.ndarray
    ) -> FalsePositiveBatch:
        crop_index = np.concatenate([episode.false_positives.crop_index for episode in episodes])
        boxes = np.concatenate([episode.false_positives.boxes for episode in episodes]).astype(np.int64)
        if self.layout == "frames":
            points = np.zeros((len(boxes), len(VIEWS), 2))
        else:
            points = np.stack([unproject(boxes[:, v, :2], CAMERAS[view]) for v, view in enumerate(VIEWS)], 1)
        crop_index = offset_index(crop_index, offsets[steps.b][:, None])
        return FalsePositiveBatch(steps.pad(crop_index), steps.pad(boxes), steps.pad(points))

    def _token_sequence(self, prompt: PreprocessedPrompt) -> "_TokenSequence":
        """Build the token sequence of a prompt: words, and one or more tokens per object of an image.

        With layout "views" every image is padded to the slots of the prompt's largest one, as in the
        published evaluation, where this affects T5's relative positions.
        """
        counts = tuple(prompt.objects_per_image.tolist())
        in_text = [piece for piece in split_prompt(prompt.text) if isinstance(piece, int)]
        is_scene = prompt.is_scene[in_text]
        if self.layout != "views":
            layout = self._layout_of(prompt.text, counts, ())
            objects = prompt.objects if layout.order is None else prompt.objects.select(layout.order)
            return _TokenSequence(layout, objects, is_scene, None)
        ends = np.cumsum(prompt.objects_per_image)
        rows = [np.arange(ends[number] - counts[number], ends[number]) for number in in_text]
        image = np.repeat(np.arange(len(rows)), [len(each) for each in rows])
        ordered = prompt.objects.select(np.concatenate([np.zeros(0, np.int64), *rows]))
        objects, slots = _compact(ordered, image, len(rows))
        layout = self._layout_of(prompt.text, counts, slots)
        mask, is_image = layout.is_word.copy(), ~layout.is_word
        mask[is_image] = objects.masks[layout.entries[is_image], layout.parts[is_image]]
        return _TokenSequence(layout, objects, is_scene, mask)

    def _layout_of(self, text: str, counts: tuple[int, ...], slots: tuple[int, ...]) -> "_Layout":
        """Return the cached layout of a text, given the number of objects per image."""
        key = (text, counts, slots)
        if key not in self._layouts:
            if len(self._layouts) >= MAX_LAYOUTS:
                self._layouts.clear()
            self._layouts[key] = self._lay_out(*key)
        return self._layouts[key]

    def _lay_out(self, text: str, counts: tuple[int, ...], slots: tuple[int, ...]) -> "_Layout":
        tokens: list[tuple[int, int, int]] = []  # word, entry, part
        starts, order, count = np.cumsum([0, *counts]), [], 0
        sizes: list[int] = []  # rows of each image
        for piece in split_prompt(text):
            if isinstance(piece, str):
                tokens += [(word, WORD, 0) for word in self.tokenizer.encode(piece)]
                continue
            order += range(starts[piece], starts[piece + 1])
            sizes.append({"views": max(slots, default=0), "frames": 1, "objects": counts[piece]}[self.layout])
            if self.layout == "views":
                tokens += [(PADDING_ID, count + k, v) for v, size in enumerate(slots) for k in range(size)]
            elif self.layout == "frames":
                tokens += [(PADDING_ID, count, part) for part in range(self.tokens_per_frame_pair)]
            else:
                tokens += [(PADDING_ID, count + k, 0) for k in range(counts[piece])]
            count += sizes[-1]
        tokens.append((self.tokenizer.end_id, WORD, 0))
        check_length(
            len(tokens), MAX_PROMPT_POSITIONS, "the prompt"
        )  # before the encoder, whose cost is quadratic
        words, entries, parts = np.array(tokens).T
        is_word, images = entries == WORD, np.repeat(np.arange(len(sizes)), sizes)
        in_other_order = None if order == list(range(starts[-1])) else np.array(order)
        return _Layout(words, np.maximum(entries, 0), parts, is_word, images, in_other_order)


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """The tokens of a prompt: word, or row and part of its object.

    `images` is the image of each row, counted in reading order; `order` the rows in reading order, None for
    the stored order.
    """

    words: np.ndarray
    entries: np.ndarray
    parts: np.ndarray
    is_word: np.ndarray
    images: np.ndarray
    order: np.ndarray | None


@dataclass(frozen=True, slots=True, eq=False)
class _TokenSequence:
    """One prompt: layout, objects, which images are scenes, and the token mask (None: all valid)."""

    layout: _Layout
    objects: ObjectTable
    is_scene: np.ndarray
    mask: np.ndarray | None


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """Episode `b` and time `t` of each step, and the mask of a padded array, (B, T)."""

    b: np.ndarray
    t: np.ndarray
    exists: np.ndarray

    @staticmethod
    def of(lengths: Sequence[int]) -> "_Steps":
        """Number the steps of episodes of these lengths."""
        exists = np.arange(max(lengths, default=0)) < np.array(lengths)[:, None]
        b, t = np.nonzero(exists)
        return _Steps(b, t, exists)

    def pad(self, column: np.ndarray, fill: int = 0) -> np.ndarray:
        """Scatter one row per step into a padded array of shape (B, T, …)."""
        result = np.full((*self.exists.shape, *column.shape[1:]), fill, column.dtype)
        result[self.b, self.t] = column
        return result


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


def _on_table(pixels: np.ndarray, from_top: np.ndarray) -> np.ndarray:
    """Points under pixels of both views, shape (N, 2, 2): from the top view if it shows the object."""
    front = unproject(pixels[:, FRONT], CAMERAS["front"])
    return np.where(from_top[:, None], unproject(pixels[:, TOP], CAMERAS["top"]), front)
