"""Explanations of a network's last step, out of its trace."""

import math
from collections.abc import Iterator, Mapping

import numpy as np
import torch

from openvima.perception.objects import TOP, ObjectViews
from openvima.perception.preprocessing import extract_observation
from openvima.policies.batch import WORD, PromptBatch
from openvima.policies.nn.actions import ACTION_PARTS
from openvima.policies.nn.policy_network import StepTrace
from openvima.policies.pointer.inputs import bin_to_yaw
from openvima.policies.pointer.words import coreference
from openvima.policies.processor import Processor, order_in_view
from openvima.render.camera import VIEWS
from openvima.scene import RenderedPrompt
from openvima.scene.explanation import PLACE_KINDS, Explanation, ObjectProbability, PlaceProbability
from openvima.video.prompt_strip import prompt_pieces

COMPONENTS = tuple(
    f"{key}.{axis}" for key, part in ACTION_PARTS.items() for axis in "xyzw"[: part.stop - part.start]
)


def explain_row(
    trace: StepTrace,
    row: int,
    action: Mapping[str, np.ndarray],
    prompt: RenderedPrompt,
    observation: Mapping,
    processor: Processor,
    *,
    temperature: float,
    follow_coreference: bool,
) -> Explanation:
    """Explain the action of one episode.

    Args:
        trace: What the network computed for the step.
        row: Row of the episode in it.
        action: The action.
        prompt: Prompt of the episode.
        observation: Its last observation.
        processor: Encoded prompt and observation for the network.
        temperature: Divisor of the logits, with sampling; 0 without.
        follow_coreference: Whether words have the appearance of the images they refer to; attention to such a
            word counts as attention to these images then.
    """

    def probabilities(logits: torch.Tensor) -> np.ndarray:
        return torch.softmax(logits[row].to("cpu", torch.float64) / (temperature or 1.0), dim=-1).numpy()

    batch, _ = processor.encode_prompts([prompt])
    words, piece_L = _prompt_pieces(prompt, batch, processor)
    attention = {}
    for kind, weights_BL in trace.attention.items():
        weights_L = weights_BL[row, : len(piece_L)].to("cpu", torch.float64)
        if follow_coreference:
            refers_LL = coreference(batch)[0].to(torch.float64)
            weights_L = weights_L * (refers_LL.sum(dim=1) == 0) + weights_L @ refers_LL
        weights_L = weights_L / weights_L.sum()  # exactly, whatever the network computes in
        attention[kind] = np.bincount(piece_L, weights_L.numpy(), minlength=len(words))
    bins = {name: probabilities(logits) for name, logits in zip(COMPONENTS, trace.bins, strict=False)}
    if trace.places is None:
        return Explanation(action, words, attention, bins=bins)
    positions_BC2, masks_BC, kinds_C = trace.places
    picks, places, *rotation = map(probabilities, trace.logits)
    found = extract_observation(observation, processor.input_kind, processor.extractor)
    grasps = found.positions() if bins else found.grasp_points()
    if processor.layout == "views":
        order = order_in_view(found.ids, found.masks[TOP], np.zeros_like(found.ids))
        picks = picks[np.argsort(order)]
    return Explanation(
        action,
        words,
        attention,
        tuple(_objects(found, grasps, picks, has_ids=processor.extractor is None)),
        tuple(
            PlaceProbability(PLACE_KINDS[kinds_C[index]], (x, y), float(places[index]))
            for index, (x, y) in enumerate(positions_BC2[row].tolist())
            if masks_BC[row, index]
        ),
        *((_yaws(len(rotation[0])), rotation[0]) if rotation else ()),
        bins=bins,
    )


def _yaws(count: int) -> np.ndarray:
    yaws = bin_to_yaw(torch.arange(count), count, torch.float64).numpy()
    return (yaws + math.pi) % (2 * math.pi) - math.pi


def _objects(
    found: ObjectViews, grasps: np.ndarray, picks: np.ndarray, *, has_ids: bool
) -> Iterator[ObjectProbability]:
    for slot, (object_id, (x, y)) in enumerate(zip(found.ids.tolist(), grasps.tolist(), strict=True)):
        boxes = {
            view: tuple(found.boxes[v, slot].tolist()) for v, view in enumerate(VIEWS) if found.masks[v, slot]
        }
        yield ObjectProbability(object_id if has_ids else -1, boxes, (x, y), float(picks[slot]))


def _prompt_pieces(
    prompt: RenderedPrompt, batch: PromptBatch, processor: Processor
) -> tuple[tuple[str, ...], np.ndarray]:
    """Return words and images of a prompt and an empty end, and which of them each position belongs to."""
    rows_L, image_index_S = batch.object_index_BL[0].numpy(), batch.image_index_S.numpy()
    shown = prompt_pieces(prompt)
    words = (*(piece if isinstance(piece, str) else f"{{{piece.name}}}" for piece in shown), "")
    of_words: list[int] = []
    of_images: list[int] = []
    for number, piece in enumerate(shown):
        if isinstance(piece, str):
            of_words += [number] * len(processor.tokenizer.encode(piece))
        else:
            of_images.append(number)
    is_word_L = rows_L == WORD
    num_words = int(is_word_L.sum())
    piece_L = np.empty(len(rows_L), np.int64)
    # All but the end token; should a tokenizer split a whole text in fewer tokens, the last ones are the end.
    piece_L[is_word_L] = [*of_words[: num_words - 1], *[len(shown)] * num_words][:num_words]
    # Further tokens of the objects, such as those of the second view, are numbered after all first ones.
    object_rows = rows_L[~is_word_L] % max(1, len(image_index_S))
    piece_L[~is_word_L] = np.array(of_images, np.int64)[image_index_S[object_rows]]
    return words, piece_L
