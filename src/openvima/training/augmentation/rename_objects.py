"""Prompt augmentation: objects get novel nouns.

"Put the {a} into the {b}."    "This is a wug {b}. This is a dax {a}. Put the dax into the wug."
"""

import re
from dataclasses import replace

import numpy as np

from openvima.data.preprocessed import PreprocessedEpisode
from openvima.perception.preprocessing import ObjectTable
from openvima.tasks.novel_words import ADJECTIVES, NOUNS
from openvima.tasks.sweep_table import NUMBER_WORDS
from openvima.training.augmentation.prompt_images import DEFINITION, images_by_name, with_prompt

MAX_NAMES = 2
_NOVEL_WORD = re.compile(rf"\b({'|'.join(NOUNS + ADJECTIVES)})\b")
_DETERMINERS = ("the", "same", "any", "all", *NUMBER_WORDS)  # words after which a noun needs no article


def renamed(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Name one or two single objects of a prompt by novel nouns.

    Half of these prompts also define nouns of unused objects in view, so that nouns have to be read. Only
    table rows are copied, no images. Prompts with novel words of their own or without single objects are
    unchanged.
    """
    images = images_by_name(episode.prompt)
    named = [name for name, (objects, is_scene) in images.items() if len(objects) == 1 and not is_scene]
    if not named or _NOVEL_WORD.search(episode.prompt.text):
        return episode
    count = int(rng.integers(1, min(MAX_NAMES, len(named)) + 1))
    chosen = [named[int(number)] for number in rng.permutation(len(named))[:count]]
    nouns = [NOUNS[int(number)] for number in rng.permutation(len(NOUNS))]
    text = episode.prompt.text
    for name, noun in zip(chosen, nouns, strict=False):
        text = re.sub(rf"(\w+) \{{{name}\}}", lambda found, noun=noun: _noun_phrase(found[1], noun), text)
    if rng.random() < 0.5:
        others = _unused_in_view(episode, images[chosen[0]][0], rng)[: len(NOUNS) - count]
        images |= {f"other_{number}": (objects, False) for number, objects in enumerate(others)}
        chosen += [f"other_{number}" for number in range(len(others))]
    defined = [
        DEFINITION.format(noun=noun, image=f"{{{name}}}") for name, noun in zip(chosen, nouns, strict=False)
    ]
    text = " ".join([*(defined[int(number)] for number in rng.permutation(len(defined))), text])
    return with_prompt(episode, text, images)


def _unused_in_view(
    episode: PreprocessedEpisode, single: ObjectTable, rng: np.random.Generator
) -> list[ObjectTable]:
    """Make prompt images of objects that the first step does not use, in random order.

    They have the crops of the scene and the boxes of a single object in a prompt image.

    Args:
        episode: The demonstration.
        single: The row of such a single object.
        rng: Draws the order.
    """
    first = episode.objects.select(slice(0, int(episode.objects_per_step[0])))
    first = first.select(~np.isin(first.ids, [episode.pick_ids[0], episode.place_ids[0]]))
    rows = single.select(np.zeros(len(first), np.int64))
    # A hidden object has no box.
    rows = replace(rows, crop_index=first.crop_index, boxes=rows.boxes * first.masks[..., None])
    return [rows.select(np.array([number])) for number in rng.permutation(len(rows))]


def _noun_phrase(before: str, noun: str) -> str:
    return f"{before} {noun}" if before.lower() in _DETERMINERS else f"{before} the {noun}"
