"""The same demonstration told in other words, or with less beside the point; what is to be done stays.

"Put the {a} into the {b}."    "This is a wug {b}. This is a dax {a}. Put the dax into the wug."
"""

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from openvima.data.object_cache.episode import PreprocessedEpisode
from openvima.perception.preprocessing import ObjectTable, PreprocessedPrompt, image_names
from openvima.tasks.novel_words import ADJECTIVES, NOUNS

MOST_NAMES = 2
DEFINITION = "This is a {noun} {image}."
_SENTENCE_END = re.compile(r"(?<=\.) ")
_IS_COMPARISON = re.compile(r"\} is \w+ than \{")
_INVENTED = re.compile(rf"\b({'|'.join(NOUNS + ADJECTIVES)})\b")
_Image = tuple[ObjectTable, bool]  # its objects, and whether it is a scene
_DETERMINED = ("the", "same", "any", "all")  # words after which a noun needs no article


def as_named(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Return the same demonstration with invented nouns for one or two objects that its prompt shows alone.

    Half of these prompts also name things that do not matter, as they are seen in the scene, so that nouns
    have to be read. Nothing is drawn or copied but rows of numbers. A prompt that has invented words of its
    own, as those of `novel_noun` and `novel_adj`, stays as it is, and so does one that shows no object alone.
    """
    images = _images(episode.prompt)
    named = [name for name, (objects, is_scene) in images.items() if len(objects) == 1 and not is_scene]
    if not named or _INVENTED.search(episode.prompt.text):
        return episode
    count = int(rng.integers(1, min(MOST_NAMES, len(named)) + 1))
    chosen = [named[int(number)] for number in rng.permutation(len(named))[:count]]
    nouns = [NOUNS[int(number)] for number in rng.permutation(len(NOUNS))]
    text = episode.prompt.text
    for name, noun in zip(chosen, nouns, strict=False):
        text = re.sub(rf"(\w+) \{{{name}\}}", lambda found, noun=noun: _noun_phrase(found[1], noun), text)
    if rng.random() < 0.5:
        others = _others_in_view(episode, images[chosen[0]][0], rng)[: len(NOUNS) - count]
        images |= {f"other_{number}": (objects, False) for number, objects in enumerate(others)}
        chosen += [f"other_{number}" for number in range(len(others))]
    defined = [
        DEFINITION.format(noun=noun, image=f"{{{name}}}") for name, noun in zip(chosen, nouns, strict=False)
    ]
    text = " ".join([*(defined[int(number)] for number in rng.permutation(len(defined))), text])
    return _with_prompt(episode, text, images)


def in_any_order(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Return the same demonstration with the sentences that explain invented words in any order.

    Definitions and comparisons ("{a} is kobar than {b}.") may then come after the instruction, and of several
    comparisons perhaps only some are left, one at least. So what an image is for has to be read from the
    words around it and does not follow from its place. Other prompts stay as they are.
    """
    explaining, comparisons, instruction = [], [], []
    for sentence in _SENTENCE_END.split(episode.prompt.text):
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
    return _with_prompt(episode, text, _images(episode.prompt))


def _images(prompt: PreprocessedPrompt) -> dict[str, _Image]:
    """The objects of each prompt image, and whether it is a scene, by its name."""
    tables = prompt.objects.split(prompt.objects_per_image)
    return dict(zip(prompt.image_names, zip(tables, prompt.is_scene.tolist(), strict=True), strict=True))


def _with_prompt(
    episode: PreprocessedEpisode, text: str, images: Mapping[str, _Image]
) -> PreprocessedEpisode:
    """The demonstration with another prompt, which shows some of these images."""
    tables, is_scene = zip(*(images[name] for name in image_names(text)), strict=True)
    prompt = PreprocessedPrompt(
        text=text,
        objects=ObjectTable.concatenate(tables),
        objects_per_image=np.array([len(table) for table in tables], np.int16),
        is_scene=np.array(is_scene, np.bool_),
    )
    return replace(episode, prompt=prompt)


def _others_in_view(
    episode: PreprocessedEpisode, alone: ObjectTable, rng: np.random.Generator
) -> list[ObjectTable]:
    """Rows for pictures of objects that the first step does nothing with, in any order.

    They show the crops of the scene, in the middle of the picture as single objects stand there.

    Args:
        episode: The demonstration.
        alone: The row of a picture of a single object.
        rng: Draws the order.
    """
    first = episode.objects.select(slice(0, int(episode.objects_per_step[0])))
    first = first.select(~np.isin(first.ids, [episode.pick_ids[0], episode.place_ids[0]]))
    rows = alone.select(np.zeros(len(first), np.int64))
    # A hidden object has no box.
    rows = replace(rows, crop_index=first.crop_index, boxes=rows.boxes * first.masks[..., None])
    return [rows.select(np.array([number])) for number in rng.permutation(len(rows))]


def without_bystanders(
    motion: PreprocessedEpisode, share: float, rng: np.random.Generator
) -> PreprocessedEpisode:
    """Take objects that nothing is done with out of view, and others out of the pictures that show a motion.

    Args:
        motion: A demonstration that is read as a motion, with the ids of the segmentation.
        share: How probable either is for each of them.
        rng: Draws them.
    """
    ids = np.setdiff1d(motion.objects.ids, [motion.pick_ids, motion.place_ids])
    is_unseen, is_unpictured = rng.random((2, len(ids))) < share
    prompt = motion.prompt
    seen = ~np.isin(motion.objects.ids, ids[is_unseen])
    pictured = ~np.isin(prompt.objects.ids, ids[is_unpictured & ~is_unseen])
    return replace(
        motion,
        objects=motion.objects.select(seen),
        objects_per_step=_counted(motion.objects_per_step, seen),
        prompt=replace(
            prompt,
            objects=prompt.objects.select(pictured),
            objects_per_image=_counted(prompt.objects_per_image, pictured),
        ),
    )


def _counted(counts: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """How many of the rows of each group are kept."""
    group = np.repeat(np.arange(len(counts)), counts)
    return np.bincount(group[kept], minlength=len(counts)).astype(counts.dtype)


def _noun_phrase(before: str, noun: str) -> str:
    return f"{before} {noun}" if before.lower() in _DETERMINED else f"{before} the {noun}"
