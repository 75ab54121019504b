"""Prompt augmentation: a function takes a demonstration and a generator, and returns another demonstration.

What a prompt allows is read from its text and images; no task is named. `demonstrations.py` lists the
functions, in the order of their draws.

Source of inverse dynamics, whose prompt consists of the frames of the demonstration, and of descriptions in
place of object images: MIDAS (Li et al. 2023).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from openvima.data.preprocessed import PreprocessedEpisode
from openvima.perception.preprocessing import ObjectTable, PreprocessedPrompt, image_names
from openvima.policies.tokenizer import UNKNOWN
from openvima.scene import ObjectRecord, PromptImage, RenderedPrompt
from openvima.tasks.novel_words import ADJECTIVES, NOUNS
from openvima.tasks.prompts import rephrase, synonyms, training_paraphrases, with_phrases
from openvima.tasks.registry import task_spec
from openvima.tasks.sweep_table import NUMBER_WORDS
from openvima.training.config import AugmentationConfig

DEFINITION = "This is a {noun} {image}."  # as in `novel_noun`

NamedImages = dict[str, tuple[ObjectTable, bool]]


def images_by_name(prompt: PreprocessedPrompt) -> NamedImages:
    """Return the objects of each prompt image, and whether it is a scene, by its name."""
    tables = prompt.objects.split(prompt.objects_per_image)
    return dict(zip(prompt.image_names, zip(tables, prompt.is_scene.tolist(), strict=True), strict=True))


def with_prompt(
    episode: PreprocessedEpisode, text: str, images: NamedImages | None = None
) -> PreprocessedEpisode:
    """Return the demonstration with another prompt, which contains some of these images, or of its own."""
    images = images or images_by_name(episode.prompt)
    shown = [images[name] for name in image_names(text)]
    prompt = PreprocessedPrompt(
        text=text,
        objects=ObjectTable.concatenate([table for table, _ in shown]),
        objects_per_image=np.array([len(table) for table, _ in shown], np.int16),
        is_scene=np.array([is_scene for _, is_scene in shown], np.bool_),
    )
    return replace(episode, prompt=prompt)


MAX_NAMES = 2
_NOVEL_WORD = re.compile(rf"\b({'|'.join(NOUNS + ADJECTIVES)})\b")
_DETERMINERS = ("the", "same", "any", "all", *NUMBER_WORDS)  # words after which a noun needs no article


def rename_objects(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Name one or two single objects of a prompt by novel nouns.

    "Put the {a} into the {b}."    "This is a wug {b}. This is a dax {a}. Put the dax into the wug."

    Half of these prompts also define nouns of unused objects in view, so that nouns have to be read. Only
    table rows are copied, no images. Prompts with novel words of their own or without single objects are
    unchanged.
    """
    images = images_by_name(episode.prompt)
    named = [name for name, (objects, is_scene) in images.items() if len(objects) == 1 and not is_scene]
    if not named or _NOVEL_WORD.search(episode.prompt.text):
        return episode
    count = rng.integers(1, min(MAX_NAMES, len(named)) + 1)
    chosen = [named[number] for number in rng.permutation(len(named))[:count]]
    nouns = [NOUNS[number] for number in rng.permutation(len(NOUNS))]
    text = episode.prompt.text
    for name, noun in zip(chosen, nouns, strict=False):
        text = re.sub(rf"(\w+) \{{{name}\}}", lambda found, noun=noun: _noun_phrase(found[1], noun), text)
    if rng.random() < 0.5:
        # Objects that the first step does not use, in random order, as prompt images: with the crops of the
        # scene, and the boxes of a single object in a prompt image; a hidden object has no box.
        first = episode.objects.select(slice(0, int(episode.objects_per_step[0])))
        first = first.select(~np.isin(first.ids, [episode.pick_ids[0], episode.place_ids[0]]))
        rows = images[chosen[0]][0].select(np.zeros(len(first), np.int64))
        rows = replace(rows, crop_index=first.crop_index, boxes=rows.boxes * first.masks[..., None])
        for number, row in enumerate(rng.permutation(len(rows))[: len(NOUNS) - count]):
            images[f"other_{number}"] = rows.select(np.array([row])), False
            chosen.append(f"other_{number}")
    defined = [
        DEFINITION.format(noun=noun, image=f"{{{name}}}") for name, noun in zip(chosen, nouns, strict=False)
    ]
    text = " ".join([*(defined[number] for number in rng.permutation(len(defined))), text])
    return with_prompt(episode, text, images)


def _noun_phrase(before: str, noun: str) -> str:
    return f"{before} {noun}" if before.lower() in _DETERMINERS else f"{before} the {noun}"


_SENTENCE_END = re.compile(r"(?<=\.) ")
_IS_COMPARISON = re.compile(r"\} is \w+ than \{")


def shuffle_sentences(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Shuffle definitions, comparisons ("{a} is kobar than {b}.") and the instruction.

    At least one of several comparisons is kept. The purpose of an image then follows from the words around it
    and not from its position. Other prompts are unchanged.
    """
    definitions, comparisons, instruction = [], [], []
    for sentence in _SENTENCE_END.split(episode.prompt.text):
        if not _defines(sentence):
            instruction.append(sentence)
        elif _IS_COMPARISON.search(sentence):
            comparisons.append(sentence)
        else:
            definitions.append(sentence)
    if comparisons:
        kept = rng.permutation(len(comparisons))[: rng.integers(1, len(comparisons) + 1)]
        definitions += [comparisons[number] for number in kept]
    if not definitions:
        return episode
    blocks = [*definitions, " ".join(instruction)]
    text = " ".join(blocks[number] for number in rng.permutation(len(blocks)))
    return with_prompt(episode, text)


MAX_DEFINITIONS = 3


def with_unused_definitions(
    episode: PreprocessedEpisode, other: PreprocessedEpisode, rng: np.random.Generator
) -> PreprocessedEpisode:
    """Insert up to three sentences of another prompt that define words, before the instruction.

    The words are exchanged for some that this prompt lacks, so that nothing in it refers to them: which
    sentences count has to be read, and they are at no position of their own. Only table rows are copied.

    Args:
        episode: The demonstration.
        other: Its prompt has the sentences; the images of both are numbered in one stack.
        rng: Draws sentences, words and positions.
    """
    there = [s for s in _SENTENCE_END.split(other.prompt.text) if _defines(s)]
    own = _SENTENCE_END.split(episode.prompt.text)
    num_leading = next((n for n, sentence in enumerate(own) if not _defines(sentence)), len(own))
    words: dict[str, str] = {}
    taken, said = (_NOVEL_WORD.findall(each.prompt.text) for each in (episode, other))
    for kind in (NOUNS, ADJECTIVES):
        free = [word for word in kind if word not in taken]
        used = [word for word in kind if word in said]
        words |= zip(used, (free[n] for n in rng.permutation(len(free))), strict=False)
    for index in rng.permutation(len(there))[: rng.integers(1, MAX_DEFINITIONS + 1)]:
        found = _NOVEL_WORD.search(there[index])
        if found and found[0] in words:
            sentence = there[index].replace(f" {found[0]} ", f" {words[found[0]]} ")
            own.insert(rng.integers(num_leading + 1), sentence.replace("{", "{unused_"))
            num_leading += 1
    images = {f"unused_{name}": image for name, image in images_by_name(other.prompt).items()}
    return with_prompt(episode, " ".join(own), images | images_by_name(episode.prompt))


def _defines(sentence: str) -> bool:
    return bool(_IS_COMPARISON.search(sentence)) or sentence.startswith(DEFINITION.partition("{")[0])


_COMPARISON = re.compile(r"(\{\w+\}) is (\w+) than (\{\w+\})")
_LESS = re.compile(r"\bless (?=\w+ \{)")


def turn_comparisons(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Ask without "less", and turn all comparisons round, which means the same.

    "{a} is kobar than {b}. Put the less kobar {c} …"    "{b} is kobar than {a}. Put the kobar {c} …"

    Where half of the prompts say "less", neither the comparisons nor the objects tell anything by themselves
    of the one to pick, and a network hardly begins to learn what they tell together.
    """
    text, count = _LESS.subn("", episode.prompt.text)
    text = _COMPARISON.sub(r"\3 is \2 than \1", text)
    return with_prompt(episode, text) if count else episode


def paraphrase(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Put a paraphrase in place of a prompt; tasks without any, and prompts of other forms, are unchanged.

    Args:
        episode: The demonstration.
        rng: Draws the paraphrase.
    """
    phrasings = training_paraphrases().get(episode.task)
    if not phrasings:
        return episode
    template, phrasing = task_spec(episode.task).template, phrasings[rng.integers(len(phrasings))]
    text = rephrase(episode.prompt.text, template, phrasing)
    return episode if text is None else with_prompt(episode, text)


_FORMS = "all {x}. {x}. is a zup {x}"  # plural, articles and colon, which descriptions bring with them


def describe_objects(
    episode: PreprocessedEpisode, rng: np.random.Generator, config: AugmentationConfig
) -> PreprocessedEpisode:
    """Replace object images of a task prompt by texture and name of the object.

    "Put the {a} into the {b}."    "Put the red swirl letter A into the {b}."

    Args:
        episode: The demonstration.
        rng: Draws the images.
        config: `text_description_prob`, `text_prompt_prob` and `synonym_prob` count.
    """
    prompt_prob = config.text_prompt_prob
    prob = 1.0 if prompt_prob and rng.random() < prompt_prob else config.text_description_prob
    if config.synonym_prob:
        episode = with_synonyms(episode, config.synonym_prob, rng)
    return with_descriptions(episode, prob, rng)


def with_descriptions(
    episode: PreprocessedEpisode, prob: float, rng: np.random.Generator
) -> PreprocessedEpisode:
    """Replace some object images by their descriptions; images without one stay.

    Args:
        episode: The demonstration.
        prob: Probability for each image.
        rng: Draws the images.
    """
    names = [name for name in episode.prompt.image_names if name in episode.descriptions]
    chosen = [name for name, draw in zip(names, rng.random(len(names)), strict=True) if draw < prob]
    if not chosen:
        return episode
    text = with_phrases(episode.prompt.text, {name: episode.descriptions[name] for name in chosen})
    return with_prompt(episode, text)


def with_synonyms(episode: PreprocessedEpisode, prob: float, rng: np.random.Generator) -> PreprocessedEpisode:
    """Replace the names in some descriptions by aliases; those of objects without any stay.

    Args:
        episode: The demonstration.
        prob: Probability for each description.
        rng: Draws descriptions and aliases.
    """
    said = dict(episode.descriptions)
    for name, draw, choice in zip(said, rng.random(len(said)), rng.random(len(said)), strict=True):
        if draw < prob and (others := synonyms(said[name])):
            said[name] = others[int(choice * len(others))]
    return replace(episode, descriptions=said)


def text_of(description: str) -> str:
    """Return a text with all words that a description brings into prompts: article and plural, too."""
    return with_phrases(_FORMS, {"x": description})


_SLOT_OR_WORD = re.compile(rf"\{{\w+\}}|{UNKNOWN}|[^\W\d_]+(?:-[^\W\d_]+)*")


def mask_words(episode: PreprocessedEpisode, rng: np.random.Generator, *, prob: float) -> PreprocessedEpisode:
    """Replace words of a prompt by the unknown token; images, numbers and punctuation stay.

    Args:
        episode: The demonstration.
        rng: Draws the words.
        prob: Probability for each word.
    """

    def mask(found: re.Match[str]) -> str:
        is_word = found[0][0] != "{"
        return UNKNOWN if is_word and rng.random() < prob else found[0]

    text = _SLOT_OR_WORD.sub(mask, episode.prompt.text)
    return replace(episode, prompt=replace(episode.prompt, text=text))


def shuffle_prompt_objects(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Permute the objects of each prompt image, independently.

    Generated demonstrations list an object at the same position in all frames of a prompt, which tells what
    moved without looking. Neither detectors nor VIMA-Bench's `follow_order` do.
    """
    counts = episode.prompt.objects_per_image.astype(np.int64)
    firsts = np.cumsum(counts) - counts
    rows = [first + rng.permutation(count) for first, count in zip(firsts, counts, strict=True)]
    objects = episode.prompt.objects.select(np.concatenate([np.zeros(0, np.int64), *rows]))
    return replace(episode, prompt=replace(episode.prompt, objects=objects))


MOTION_TEXT = "Follow this motion: {frames}."


def with_motion_prompt(episode: PreprocessedEpisode) -> PreprocessedEpisode:
    """Replace the prompt by the frames of the demonstration: "Follow this motion: {frame_0} … {frame_T}.".

    The frames are the observations before each action and after the last, whatever the task. Only table rows
    are copied: the prompt refers to the images of the history. Nothing is left of the task's own prompt.

    Args:
        episode: The demonstration. In a prompt image its objects are ordered by id, as in the scenes of task
            prompts. Objects without any box, which stand for steps without detections, are left out.
    """
    objects = ObjectTable.concatenate([episode.objects, episode.final])
    num_frames = episode.num_steps + 1
    frame = np.repeat(np.arange(num_frames), [*episode.objects_per_step, len(episode.final)])
    order = np.lexsort((objects.ids, frame))
    order = order[np.asarray(objects.masks.any(axis=1))[order]]
    prompt = PreprocessedPrompt(
        text=motion_text(num_frames),
        objects=objects.select(order),
        objects_per_image=np.bincount(frame[order], minlength=num_frames).astype(np.int16),
        is_scene=np.ones(num_frames, np.bool_),
    )
    return replace(episode, prompt=prompt)


def motion_prompt(observations: Sequence[Mapping], objects: Sequence[ObjectRecord]) -> RenderedPrompt:
    """Make the prompt of an in-context demonstration.

    Args:
        observations: `rgb` and `segm`, each view name to array.
        objects: The objects of the scene.
    """
    records = tuple(sorted(objects, key=lambda record: record.object_id))
    images = {}
    for number, seen in enumerate(observations):
        name = f"frame_{number}"
        images[name] = PromptImage(name, "scene", dict(seen["rgb"]), dict(seen["segm"]), records)
    return RenderedPrompt(motion_text(len(images)), images)


def motion_text(num_frames: int) -> str:
    """Return the text for so many frames, with a placeholder for each."""
    frames = " ".join(f"{{frame_{number}}}" for number in range(num_frames))
    return MOTION_TEXT.format(frames=frames)
