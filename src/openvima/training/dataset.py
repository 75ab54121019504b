"""Demonstrations as tokens, and batches of them as a network takes them.

Shape suffixes: B batch, T steps, N objects in view, V views, C components of an action.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from openvima.data.records import Demonstration
from openvima.data.tokens.episode import IMAGE_SIZES, TokenEpisode, TokenKind, pieces_of, tokens_of
from openvima.errors import DatasetError
from openvima.policies.heads.base import ActionTargets
from openvima.policies.inputs import HistoryBatch, PromptBatch, Reader
from openvima.training.schedule import step_seed


@dataclass(frozen=True, slots=True, eq=False)
class Spurious:
    """False detections: for each step one rectangle of each view that shows no object in particular.

    Policies that see whole frames have no detections, true or false; all is 0 for them.

    Args:
        crops: Numbers of the crops, shape (B, T, 2).
        boxes: Boxes in pixels, shape (B, T, 2, 4).
        points: Table points under their centres, shape (B, T, 2, 2), metres.
    """

    crops: np.ndarray
    boxes: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One demonstration whose images are part of a stack.

    Args:
        tokens: The demonstration; its own images may be left out.
        base: Images of the stack before its own: its image n is number `base + n` there, and 0 stays 0.
    """

    tokens: TokenEpisode
    base: int


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Several demonstrations, padded.

    Args:
        prompts: What the robot was told.
        history: What it saw.
        targets: What it did.
        spurious: A false detection for each step and view.
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


def token_kind(reader: Reader) -> TokenKind:
    """Return what a network's images show: objects, or whole frames."""
    return "frames" if reader.layout == "frames" else "objects"


def read_examples(
    episodes: Iterable[Demonstration | TokenEpisode], reader: Reader, *, validation_share: float
) -> Examples:
    """Collect demonstrations in memory.

    Whether one is for validation follows from its task and seed, so that it stays there when data are added.

    Args:
        episodes: Demonstrations, or their tokens.
        reader: How the network sees prompts and observations.
        validation_share: Share of the demonstrations to keep for validation.

    Raises:
        DatasetError: There is none to learn from.
        PromptError: A prompt has a word that the vocabulary lacks.
    """
    parts: tuple[list[Example], list[Example]] = ([], [])
    tokens = [
        tokens_of(episode, token_kind(reader)) if isinstance(episode, Demonstration) else episode
        for episode in episodes
    ]
    for text in {episode.text for episode in tokens}:
        for piece in pieces_of(text):
            if isinstance(piece, str):
                reader.tokenizer.encode(piece)  # rather now than in the middle of the run
    examples, images = stack_images(tokens, reader)
    for example in examples:
        example = replace(example, tokens=replace(example.tokens, images=example.tokens.images[:0]))
        parts[_is_held_out(example.tokens, validation_share)].append(example)
    if not parts[0]:
        raise DatasetError(
            "there is no demonstration to learn from; generate some, or lower validation_share."
        )
    return Examples(tuple(parts[0]), tuple(parts[1]), images)


def stack_images(episodes: Sequence[TokenEpisode], reader: Reader) -> tuple[list[Example], torch.Tensor]:
    """Put the images of some demonstrations into one stack, behind a black one.

    Returns:
        The demonstrations, and the stack, shape (K, 3, height, width), uint8.
    """
    size = IMAGE_SIZES[token_kind(reader)]
    stack = np.concatenate([np.zeros((1, 3, *size), np.uint8), *(episode.images for episode in episodes)])
    bases = np.cumsum([0, *(len(episode.images) for episode in episodes)]).tolist()
    examples = [Example(episode, base) for episode, base in zip(episodes, bases[:-1], strict=True)]
    return examples, torch.from_numpy(stack)


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
        groups.setdefault(min(2, example.tokens.num_steps // 2), []).append(example)
    return [groups[key] for key in sorted(groups)]


def _is_held_out(episode: TokenEpisode, share: float) -> bool:
    digest = hashlib.blake2b(f"{episode.task}/{episode.seed}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") < share * 2**64
