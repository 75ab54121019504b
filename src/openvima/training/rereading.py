"""The same demonstration told in other words, or with less beside the point; what is to be done stays.

"Put the {a} into the {b}."    "This is a wug {b}. This is a dax {a}. Put the dax into the wug."
"""

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from openvima.data.object_cache.episode import (
    BOXES,
    COUNT,
    ID,
    NUMBERS,
    PICK,
    PLACE,
    PreprocessedEpisode,
    image_names,
)
from openvima.policies.inputs import on_table
from openvima.tasks.novel_words import ADJECTIVES, NOUNS

MOST_NAMES = 2
DEFINITION = "This is a {noun} {image}."
_SENTENCE_END = re.compile(r"(?<=\.) ")
_IS_COMPARISON = re.compile(r"\} is \w+ than \{")
_INVENTED = re.compile(rf"\b({'|'.join(NOUNS + ADJECTIVES)})\b")
_DETERMINED = ("the", "same", "any", "all")  # words after which a noun needs no article


def as_named(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Return the same demonstration with invented nouns for one or two objects that its prompt shows alone.

    Half of these prompts also name things that do not matter, as they are seen in the scene, so that nouns
    have to be read. Nothing is drawn or copied but rows of numbers. A prompt that has invented words of its
    own, as those of `novel_noun` and `novel_adj`, stays as it is, and so does one that shows no object alone.
    """
    names = image_names(episode.text)
    alone = _alone(episode)
    named = [name for name, is_alone in zip(names, alone, strict=True) if is_alone]
    if not named or _INVENTED.search(episode.text):
        return episode
    count = int(rng.integers(1, min(MOST_NAMES, len(named)) + 1))
    chosen = [named[int(number)] for number in rng.permutation(len(named))[:count]]
    nouns = [NOUNS[int(number)] for number in rng.permutation(len(NOUNS))]
    text = episode.text
    for name, noun in zip(chosen, nouns, strict=False):
        text = re.sub(rf"(\w+) \{{{name}\}}", lambda found, noun=noun: _noun_phrase(found[1], noun), text)
    parts = _parts(episode)
    if rng.random() < 0.5:
        others = _others_in_view(episode, parts[chosen[0]], rng)[: len(NOUNS) - count]
        parts |= {f"other_{number}": rows for number, rows in enumerate(others)}
        chosen += [f"other_{number}" for number in range(len(others))]
    defined = [
        DEFINITION.format(noun=noun, image=f"{{{name}}}") for name, noun in zip(chosen, nouns, strict=False)
    ]
    text = " ".join([*(defined[int(number)] for number in rng.permutation(len(defined))), text])
    return _with_text(episode, text, parts)


def in_any_order(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Return the same demonstration with the sentences that explain invented words in any order.

    Definitions and comparisons ("{a} is kobar than {b}.") may then come after the instruction, and of several
    comparisons perhaps only some are left, one at least. So what an image is for has to be read from the
    words around it and does not follow from its place. Other prompts stay as they are.
    """
    explaining, comparisons, instruction = [], [], []
    for sentence in _SENTENCE_END.split(episode.text):
        if _IS_COMPARISON.search(sentence):
            comparisons.append(sentence)
        elif sentence.startswith(DEFINITION.partition("{")[0]):
            explaining.append(sentence)
        else:
            instruction.append(sentence)
    if comparisons:
        kept = rng.permutation(len(comparisons))[: int(rng.integers(1, len(comparisons) + 1))]
        explaining += [comparisons[int(number)] for number in kept]
    if not explaining:
        return episode
    blocks = [*explaining, " ".join(instruction)]
    text = " ".join(blocks[int(number)] for number in rng.permutation(len(blocks)))
    return _with_text(episode, text, _parts(episode))


def _parts(episode: PreprocessedEpisode) -> dict[str, np.ndarray]:
    """Rows of the objects of each prompt image, by its name."""
    rows = np.split(episode.prompt, np.cumsum(episode.prompt_counts)[:-1])
    return dict(zip(image_names(episode.text), rows, strict=True))


def _with_text(
    episode: PreprocessedEpisode, text: str, parts: Mapping[str, np.ndarray]
) -> PreprocessedEpisode:
    """The demonstration with another prompt, which shows some of these images."""
    in_order = [parts[name] for name in image_names(text)]
    return replace(
        episode,
        text=text,
        prompt_counts=np.array([len(part) for part in in_order], episode.prompt_counts.dtype),
        prompt=np.concatenate(in_order),
    )


def _others_in_view(
    episode: PreprocessedEpisode, alone: np.ndarray, rng: np.random.Generator
) -> list[np.ndarray]:
    """Rows for pictures of objects that the first step does nothing with, in any order.

    They show the crops of the scene, in the middle of the picture as single objects stand there.

    Args:
        episode: The demonstration.
        alone: The row of a picture of a single object, shape (1, 11).
        rng: Draws the order.
    """
    first = episode.objects[: episode.steps[0, COUNT]]
    first = first[~np.isin(first[:, ID], episode.steps[0, [PICK, PLACE]])]
    rows = np.repeat(alone, len(first), axis=0)
    rows[:, NUMBERS] = first[:, NUMBERS]
    # A hidden object has no box.
    rows[:, BOXES] *= np.repeat(first[:, NUMBERS] > 0, 4, axis=1)
    return [rows[[int(number)]] for number in rng.permutation(len(rows))]


def without_bystanders(
    motion: PreprocessedEpisode, share: float, rng: np.random.Generator
) -> PreprocessedEpisode:
    """Take objects that nothing is done with out of view, and others out of the pictures that show a motion.

    Args:
        motion: A demonstration that is read as a motion, with the ids of the segmentation.
        share: How probable either is for each of them.
        rng: Draws them.
    """
    used = {int(number) for number in motion.steps[:, [PICK, PLACE]].flat}
    ids = np.array(sorted({int(number) for number in motion.objects[:, ID]} - used), np.int64)
    is_unseen, is_unpictured = rng.random((2, len(ids))) < share
    seen = ~np.isin(motion.objects[:, ID], ids[is_unseen])
    pictured = ~np.isin(motion.prompt[:, ID], ids[is_unpictured & ~is_unseen])
    steps = motion.steps.copy()
    steps[:, COUNT] = _counted(motion.steps[:, COUNT], seen)
    return replace(
        motion,
        steps=steps,
        objects=motion.objects[seen],
        prompt_counts=_counted(motion.prompt_counts, pictured).astype(motion.prompt_counts.dtype),
        prompt=motion.prompt[pictured],
    )


def _counted(counts: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """How many of the rows of each group are kept."""
    group = np.repeat(np.arange(len(counts)), counts)
    return np.bincount(group[kept], minlength=len(counts))


def _alone(episode: PreprocessedEpisode) -> np.ndarray:
    """Which images of the prompt show one object alone, shape (I,), bool."""
    image = np.repeat(np.arange(len(episode.prompt_counts)), episode.prompt_counts)
    boxes = episode.prompt[:, BOXES].reshape(-1, 2, 4).swapaxes(0, 1)
    lies = on_table(image, boxes, episode.prompt[:, NUMBERS].T > 0)
    alone = episode.prompt_counts == 1
    alone[image[lies]] = False
    return alone


def _noun_phrase(before: str, noun: str) -> str:
    return f"{before} {noun}" if before.lower() in _DETERMINED else f"{before} the {noun}"
